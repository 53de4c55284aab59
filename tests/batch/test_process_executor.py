"""Jobs in processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
from pathlib import Path
from threading import Event

import pytest
from helpers.batches import plan_seeds, repeat_sequence

from v3d_torch.batch.executor import JobFinished
from v3d_torch.batch.process_executor import ProcessExecutor


@pytest.mark.skipif(os.name == "nt", reason="no SIGSEGV to other processes")
def test_crash_of_one_process_fails_only_its_job(moment: Path, tmp_path: Path) -> None:
    planned = plan_seeds(repeat_sequence(moment, tmp_path / "long", frames=20), tmp_path / "out", seeds=2)
    ends: list[JobFinished] = []
    for event in ProcessExecutor(2)(planned, Event()):
        if isinstance(event, JobFinished):
            ends.append(event)
        elif event.job is planned[0] and event.frames == 2:
            (process,) = (child for child in multiprocessing.active_children() if child.name == str(planned[0]))
            assert process.pid is not None
            os.kill(process.pid, signal.SIGSEGV)
    failures = {end.job.config.seed: end.failure for end in ends}
    assert failures[1] is None and "killed by SIGSEGV" in str(failures[0])
    log = (planned[0].folder / "run.log").read_text()
    assert " frame 1 at " in log and "Segmentation fault" in log
    assert planned[0].earlier_outcome() is None
    outcome = planned[1].earlier_outcome()
    assert outcome is not None and outcome.metrics["tracked"] == 20
