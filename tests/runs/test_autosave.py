"""Saving of results during a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Event

import pytest
from helpers.short_wall import FRAMES, Wall, run_along_wall

from v3d_torch.config.loading import load_config
from v3d_torch.datasets.realtime_playback import RealtimePlayback
from v3d_torch.errors import OutputError
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs import result_tables
from v3d_torch.runs.autosave import Autosave
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.metrics_file import read_metrics
from v3d_torch.runs.request import RunRequest

ALWAYS = ("checkpoint.interval=0", "checkpoint.max_time_fraction=1")
REQUEST = RunRequest("wall", load_config(overrides=[*ALWAYS]))


@pytest.fixture
def live() -> Pipeline:
    """Pipeline of a live camera after some frames."""
    pipeline = run_along_wall(*ALWAYS)
    pipeline.sequence = RealtimePlayback(Wall())
    return pipeline


def replace_writer(monkeypatch: pytest.MonkeyPatch, before: Callable[[], object]) -> None:
    """Call a function before each trajectory is written."""
    write = result_tables.write_trajectory

    def write_later(path: Path, *args: object) -> None:
        before()
        write(path, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(result_tables, "write_trajectory", write_later)


def test_live_run_continues_while_files_are_written(
    live: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_write, calls = Event(), []
    replace_writer(monkeypatch, lambda: (calls.append(None), may_write.wait(30)))
    autosave = Autosave(tmp_path, live, REQUEST)
    autosave()
    autosave()  # the files of the first call are not written yet
    assert not (tmp_path / "trajectory.txt").exists()
    may_write.set()
    autosave.end()
    written = (tmp_path / "trajectory.txt").read_text().splitlines()
    assert len(written) == FRAMES and len(calls) == 3  # of frames, keyframes and ground truth
    assert read_metrics(tmp_path / "metrics.json").failure == f"killed or still running after {FRAMES} frames"
    assert (tmp_path / RunFile.CHECKPOINT).is_file()


def test_files_of_a_live_run_have_the_frames_at_the_time_of_the_save(
    live: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_write = Event()
    replace_writer(monkeypatch, lambda: may_write.wait(30))
    expected = live.slam.poses.trajectory()
    autosave = Autosave(tmp_path, live, REQUEST)
    autosave()
    live.slam.poses.replace_last(expected.T_wc[0])
    live.slam.map.keyframes[0].T_cw = expected.T_wc[-1]
    live.record.warnings.append("later")
    may_write.set()
    autosave.end()
    assert (tmp_path / "trajectory.txt").read_text().splitlines()[0].startswith("0.000000 0.000000000 ")
    assert float((tmp_path / "trajectory.txt").read_text().splitlines()[-1].split()[1]) > 0.1
    assert "later" not in (tmp_path / "metrics.json").read_text()


def test_error_of_the_thread_is_recorded(live: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise OutputError("trajectory.txt: cannot be written (full); free the disk")

    replace_writer(monkeypatch, fail)
    autosave = Autosave(tmp_path, live, REQUEST)
    autosave()
    autosave.end()
    assert live.record.save_error is not None and "cannot be written (full)" in live.record.save_error


def test_error_of_the_program_in_the_thread_ends_the_run_but_not_the_final_results(
    live: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    replace_writer(monkeypatch, fail)
    autosave = Autosave(tmp_path, live, REQUEST)
    autosave()
    autosave.end()
    assert "autosave failed" in caplog.text and "ZeroDivisionError" in caplog.text
    with pytest.raises(ZeroDivisionError):
        autosave()


@pytest.mark.parametrize("limits", [("interval=1000", "max_time_fraction=1"), ("interval=0", "max_time_fraction=1e-6")])
def test_next_save_is_due_after_the_interval_and_after_the_maximum_fraction_of_time(
    limits: tuple[str, str], tmp_path: Path
) -> None:
    pipeline = run_along_wall(*(f"checkpoint.{limit}" for limit in limits))
    autosave = Autosave(tmp_path, pipeline, None)
    autosave._due = 0.0
    autosave()
    (tmp_path / "trajectory.txt").unlink()
    autosave()
    assert not (tmp_path / "trajectory.txt").exists()
