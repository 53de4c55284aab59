"""Jobs in processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
from pathlib import Path
from threading import Event

import pytest
from helpers.batches import plan_seeds, repeat_sequence

from v3d_torch.batch import process_executor
from v3d_torch.batch.executor import JobFinished
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


@pytest.mark.skipif(os.name == "nt", reason="no fork server")
@pytest.mark.parametrize(("workers", "length", "method"), [(2, 80, "forkserver"), (2, 86, "spawn"), (1, 80, "spawn")])
def test_jobs_fork_unless_they_have_threads_or_the_path_of_the_socket_is_too_long(
    workers: int, length: int, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A socket has 18 more characters than its folder; 103 is the limit."""
    monkeypatch.setattr(process_executor, "get_temp_dir", lambda: "/" + "t" * (length - 1))
    assert process_executor._choose_context(workers).get_start_method() == method
