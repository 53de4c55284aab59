"""Ctrl-C while live commands wait for a camera that was unplugged."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.simulated_realsense import SimulatedDevice
from helpers.waiting import wait_until
from typer.testing import CliRunner, Result

from v3d_torch.cli.commands import app
from v3d_torch.datasets import load_sequence
from v3d_torch.errors import InputError

pytestmark = [
    pytest.mark.usefixtures("no_figures"),
    pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself"),
]

PATIENCE = 15.0
"""Time after which Ctrl-C is pressed again, so that the test fails and does not wait, seconds."""


def call_until_unplugged(monkeypatch: pytest.MonkeyPatch, count_frames: Callable[[], int], *arguments: str) -> Result:
    """Call a live command, unplug the camera after some frames, and press Ctrl-C once while the command waits."""
    device = SimulatedDevice(scale=5, still=True)
    waiting, ended, pressed_again = threading.Event(), threading.Event(), threading.Event()

    def open_device(*request: object) -> SimulatedDevice:
        if device.unplugged.is_set():
            waiting.set()
            raise InputError("no camera is connected")
        return device

    def unplug_and_interrupt() -> None:
        try:
            wait_until(lambda: count_frames() >= 4, PATIENCE, "four frames were processed")
            device.unplugged.set()
            assert waiting.wait(PATIENCE), "the command does not wait for the camera"
        finally:
            os.kill(os.getpid(), signal.SIGINT)
        if not ended.wait(PATIENCE):
            pressed_again.set()
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("v3d_torch.datasets.realsense.realsense_camera.open_live_device", open_device)
    interrupter = threading.Thread(target=unplug_and_interrupt, daemon=True)
    interrupter.start()
    done = CliRunner().invoke(app, list(arguments))
    ended.set()
    interrupter.join()
    assert not pressed_again.is_set()
    return done


def test_ctrl_c_ends_a_recording_that_waits_for_its_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    done = call_until_unplugged(
        monkeypatch, lambda: len(list((out / "depth").glob("[0-9]*"))), "record", "--out", str(out)
    )
    frames = len(load_sequence(str(out)))
    assert (done.exit_code, done.stdout) == (0, f"{frames} frames: {out}\n") and frames >= 4, done.output


def test_ctrl_c_ends_a_run_that_waits_for_its_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    log = out / "run.log"
    done = call_until_unplugged(
        monkeypatch,
        lambda: log.read_text().count("INFO frame") if log.exists() else 0,
        *("run", "--seq", "realsense:", "--segmenter", "none", "--set", "threads=1", "--out", str(out)),
    )
    assert done.exit_code == 0, done.output
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["failure"] is None and metrics["processed"] >= 4
