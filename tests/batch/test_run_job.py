"""Execution of one job: continuation from its checkpoint, and folders to which another run writes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.batches import plan_seeds, repeat_sequence

from v3d_torch.batch.job import Job
from v3d_torch.batch.run_job import run_job
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.result_folder import lock_results

pytestmark = pytest.mark.usefixtures("no_figures")


def stop_after(frames: int) -> tuple[list[int], Callable[[int], None]]:
    """Return the progress of a job, and the callback that fills it and interrupts the job after some frames."""
    progress: list[int] = []

    def report(done: int) -> None:
        progress.append(done)
        if done >= frames:
            raise KeyboardInterrupt

    return progress, report


def with_values(job: Job, **values: object) -> Job:
    """Return a job whose configuration has other values."""
    return replace(job, request=replace(job.request, config=job.config.model_copy(update=values)))


def test_interrupted_job_continues_after_its_sequence_was_moved(moment: Path, tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (first,) = plan_seeds(repeat_sequence(moment, tmp_path / "old" / "long", frames=8), tmp_path / "out", seeds=1)
    progress, report = stop_after(4)
    assert run_job(first, report) is not None
    assert progress == [1, 2, 3, 4] and (first.folder / RunFile.CHECKPOINT).is_file()
    (tmp_path / "old").rename(tmp_path / "new")
    (moved,) = plan_seeds(tmp_path / "new" / "long", tmp_path / "out", seeds=1)
    assert moved.folder == first.folder and moved.request.seq != first.request.seq
    progress = []
    assert run_job(moved, progress.append) is None
    assert progress == [5, 6, 7, 8]
    log = (first.folder / RunFile.LOG).read_text()
    assert all(f"frame {index} at" in log for index in range(8))


def test_interrupted_job_continues_with_another_number_of_threads(moment: Path, tmp_path: Path) -> None:
    """It changes no result."""
    (job,) = plan_seeds(moment, tmp_path / "out", seeds=1)
    _, report = stop_after(4)
    assert run_job(with_values(job, threads=3), report) is not None
    progress: list[int] = []
    assert run_job(job, progress.append) is None
    assert progress == [5, 6]


def test_interrupted_job_starts_again_if_its_configuration_has_changed(moment: Path, tmp_path: Path) -> None:
    (job,) = plan_seeds(moment, tmp_path / "out", seeds=1)
    _, report = stop_after(4)
    assert run_job(job, report) is not None
    features = job.config.features.model_copy(update={"count": 700})
    progress: list[int] = []
    assert run_job(with_values(job, features=features), progress.append) is None
    assert progress == [1, 2, 3, 4, 5, 6]


def test_interrupted_job_starts_again_in_an_empty_folder_if_its_sequence_has_changed(
    moment: Path, tmp_path: Path
) -> None:
    sequence = repeat_sequence(moment, tmp_path / "long", frames=8)
    (job,) = plan_seeds(sequence, tmp_path / "out", seeds=1)
    _, report = stop_after(4)
    assert run_job(job, report) is not None
    (job.folder / "mesh.ply").write_text("of the interrupted run")
    first, _, *others = (sequence / "associations.txt").read_text().splitlines()
    (sequence / "associations.txt").write_text("\n".join([first, *others]) + "\n")
    progress: list[int] = []
    assert run_job(job, progress.append) is None
    assert progress == list(range(1, 8)) and not (job.folder / "mesh.ply").exists()


def test_job_keeps_the_files_of_a_folder_to_which_another_run_writes(moment: Path, tmp_path: Path) -> None:
    (job,) = plan_seeds(moment, tmp_path / "out", seeds=1)
    with lock_results(job.folder):
        for name in ("run.log", "metrics.json"):
            (job.folder / name).write_text("of the other run")
        reported: list[int] = []
        failure = run_job(job, reported.append)
        assert failure is not None and not reported
        assert failure.startswith(f"{job.folder}: another run or batch is writing to this folder")
        assert {path.read_text() for path in job.folder.glob("*.*") if path.suffix != ".lock"} == {"of the other run"}
