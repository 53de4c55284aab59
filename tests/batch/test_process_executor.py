"""Jobs in processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from threading import Event

import pytest
from helpers.batches import plan_seeds, repeat_sequence

from v3d_torch.batch import process_executor
from v3d_torch.batch.executor import JobFinished, JobProgress, report_lost_process
from v3d_torch.batch.process_executor import ProcessExecutor


@pytest.mark.skipif(os.name == "nt", reason="no SIGSEGV to other processes")
def test_death_of_a_process_fails_only_its_job_and_is_in_its_log(moment: Path, tmp_path: Path) -> None:
    """The first job crashes, and the system kills the third."""
    planned = plan_seeds(repeat_sequence(moment, tmp_path / "long", frames=20), tmp_path / "out", seeds=3)
    signals = {planned[0].folder: signal.SIGSEGV, planned[2].folder: signal.SIGKILL}
    ends: list[JobFinished] = []
    for event in ProcessExecutor(2)(planned, Event()):
        if isinstance(event, JobFinished):
            ends.append(event)
        elif event.job.folder in signals and event.frames == 2:
            (process,) = (child for child in multiprocessing.active_children() if child.name == str(event.job))
            assert process.pid is not None
            os.kill(process.pid, signals[event.job.folder])
    failures = {end.job.config.seed: end.failure for end in ends}
    assert failures[1] is None and "killed by SIGSEGV" in str(failures[0])
    log = (planned[0].folder / "run.log").read_text()
    assert " frame 1 at " in log and "Segmentation fault" in log
    assert log.splitlines()[-1].endswith("ERROR its process was killed by SIGSEGV")
    reason = "its process was killed by SIGKILL, which the system does when memory runs out"
    assert failures[2] == reason
    assert (planned[2].folder / "run.log").read_text().splitlines()[-1].endswith(f"ERROR {reason}")
    assert planned[0].earlier_outcome() is None
    outcome = planned[1].earlier_outcome()
    assert outcome is not None and outcome.metrics["tracked"] == 20


@pytest.mark.skipif(os.name == "nt", reason="symbolic links on Windows need special permissions")
def test_log_of_a_job_never_follows_a_link(moment: Path, tmp_path: Path) -> None:
    """Neither with the traceback of a crash, nor with the reason of the death of a process."""
    (job,) = plan_seeds(repeat_sequence(moment, tmp_path / "long", frames=20), tmp_path / "out", seeds=1)
    job.folder.mkdir(parents=True)
    own, log = tmp_path / "notes.txt", job.folder / "run.log"
    own.write_text("own notes")
    log.symlink_to(own)
    for event in ProcessExecutor(1)([job], Event()):
        if isinstance(event, JobProgress) and event.frames == 2:
            (process,) = (child for child in multiprocessing.active_children() if child.name == str(job))
            assert process.pid is not None
            os.kill(process.pid, signal.SIGSEGV)
    assert "Segmentation fault" in log.read_text() and own.read_text() == "own notes"
    log.unlink()
    log.symlink_to(own)
    report_lost_process(job, "its machine died")
    assert log.read_text().endswith("ERROR its machine died\n") and own.read_text() == "own notes"


def test_jobs_run_where_the_path_of_the_temporary_folder_is_long(
    moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fork server has a socket there, whose path is limited to some 100 characters."""
    folder = tmp_path / ("t" * 100)
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    planned = plan_seeds(moment, tmp_path / "out", seeds=1)
    *_, end = ProcessExecutor(1)(planned, Event())
    assert isinstance(end, JobFinished) and end.failure is None


def test_job_imports_nothing_from_the_current_folder(
    moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new interpreter is started with ``-c``, which by default imports from there first."""
    (tmp_path / "socket.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process_executor, "start_method", lambda: multiprocessing.get_context("spawn"))
    planned = plan_seeds(moment, tmp_path / "out", seeds=1)
    *_, end = ProcessExecutor(1)(planned, Event())
    assert not (tmp_path / "imported").exists()
    assert isinstance(end, JobFinished) and end.failure is None


def test_command_imports_nothing_from_the_current_folder(moment: Path, tmp_path: Path) -> None:
    """Also the server whose forks run the jobs is a new interpreter."""
    (tmp_path / "socket.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\n")
    command = [Path(sys.executable).with_name("v3d-torch"), "batch", "--seqs", moment, "--configs", "baseline"]
    ended = subprocess.run(  # noqa: S603
        [*command, "--out", "out"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert not (tmp_path / "imported").exists()
