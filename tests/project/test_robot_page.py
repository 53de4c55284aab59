"""The page "On a robot": its commands and its example, with a simulated camera and with its recording in real time."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.simulated_realsense import SimulatedDevice
from helpers.waiting import wait_until
from typer.testing import CliRunner

import v3d_torch as v3d
from v3d_torch.cli.commands import app
from v3d_torch.config.loading import load_config
from v3d_torch.objects.frame_objects import MotionState

PAGE = (Path(__file__).parents[2] / "docs" / "robot.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^v3d-torch ([^#\n]*)", PAGE, re.MULTILINE)
(EXAMPLE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)

RECORDED = 8
"""Frames of the recording."""

DOWN = torch.tensor([0.0, 0.8, 0.6], dtype=torch.float64)
"""Gravity in the frame of the camera."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Working directory after the commands, in their order; the network is left out."""
    folder = tmp_path_factory.mktemp("robot")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(
            "v3d_torch.datasets.realsense.realsense_camera.open_live_device",
            lambda *request: SimulatedDevice(scale=5, still=True, accelerations=-9.8 * DOWN.numpy()[None]),
        )
        for command in COMMANDS:
            arguments = command.split()
            if arguments[0] == "run":
                arguments += ["--segmenter", "none", "--set", "threads=1"]
            if "--realtime" not in arguments:
                interrupt_when(progress(arguments))
            done = CliRunner().invoke(app, arguments)
            assert done.exit_code == 0, (command, done.output)
    return folder


def progress(arguments: list[str]) -> Callable[[], bool]:
    """Return a function that tells whether a live command has processed some frames."""
    out = Path(arguments[arguments.index("--out") + 1]).absolute()
    if arguments[0] == "record":
        return lambda: len(list((out / "depth").glob("[0-9]*"))) >= RECORDED
    return lambda: (out / "run.log").exists() and (out / "run.log").read_text().count("INFO frame") >= 4


def interrupt_when(condition: Callable[[], bool]) -> None:
    """Press Ctrl-C in this process as soon as a condition holds."""

    def wait() -> None:
        try:
            wait_until(condition, 120, "the command has processed some frames")
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=wait, daemon=True).start()


def test_page_has_commands_for_camera_and_recording() -> None:
    assert [command.split()[0] for command in COMMANDS] == ["record", "run", "run"]
    assert sum("--realtime" in command for command in COMMANDS) == 1


@pytest.mark.parametrize(("out", "bag"), [("drive", "drive.mcap"), ("replay", "replay.mcap")])
def test_commands_write_the_files_of_the_page(folder: Path, out: str, bag: str) -> None:
    metrics = json.loads((folder / out / "metrics.json").read_text())
    assert metrics["failure"] is None and metrics["latency"]["median"] > 0 and metrics["T_lw"] is not None
    gravity = torch.tensor(metrics["gravity"], dtype=torch.float64)
    torch.testing.assert_close(gravity, DOWN, rtol=0, atol=0.01)
    assert (folder / bag).stat().st_size > 0
    assert {"states.parquet", "occupancy.bt"} <= {path.name for path in (folder / out).iterdir()}


@pytest.mark.parametrize("source", ["camera", "recording"])
def test_example_runs(folder: Path, source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(
        "v3d_torch.datasets.realsense.realsense_camera.open_live_device",
        lambda *request: SimulatedDevice(scale=5, still=True),
    )
    monkeypatch.setattr(v3d, "load_config", lambda name, overrides: load_config(name, [*overrides, NO_NETWORK]))
    code = EXAMPLE
    if source == "recording":
        (line,) = re.findall(r"^camera = .*$", code, re.MULTILINE)
        code = code.replace(line, "camera = " + line.split("# or ")[1])
    code += "    if slam.poses.stamp - slam.poses.trajectory().stamps[0] > 0.1:\n        break\n"
    names: dict[str, object] = {}
    exec(code, names)  # noqa: S102
    assert names["free"].shape == names["clearance"].shape == (3,)  # type: ignore[attr-defined]


def test_objects_of_the_example_are_all_that_the_map_leaves_out_and_whose_place_is_known() -> None:
    (line,) = re.findall(r"^ *(moving = .*)$", EXAMPLE, re.MULTILINE)
    known, unknown = SimpleNamespace(is_known=True), SimpleNamespace(is_known=False)
    objects = [SimpleNamespace(motion_state=each, state=known, centroid=each) for each in MotionState]
    hidden = SimpleNamespace(motion_state=MotionState.DYNAMIC, state=unknown, centroid="nowhere")
    names: dict[str, object] = {"result": SimpleNamespace(objects=[*objects, hidden])}
    exec(line, names)  # noqa: S102
    assert names["moving"] == ["dynamic", "deforming", "unknown"]


NO_NETWORK = "segmentation.source=none"
