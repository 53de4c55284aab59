"""Runs on the machines of a Ray cluster, each in a process of its own."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Generator, Sequence
from itertools import islice
from threading import Event
from typing import Any

from v3d_torch.batch.executor import THREADS, Finished, JobProgress
from v3d_torch.batch.job import Job
from v3d_torch.batch.job_process import run_job
from v3d_torch.errors import InputError
from v3d_torch.runs.console import interrupts_between_frames

_LOOK = 0.2
"""Time between two looks at what the runs have done, seconds."""


class RayCluster:
    """An `Executor` on a Ray cluster. A run takes one core and has one thread.

    The package has to be installed on all machines, and the folders of the results and of the sequences have to be
    shared by them. A run whose process or machine dies is not run again.

    Args:
        address: as ``ray.init`` takes it: ``auto`` for the cluster that this machine belongs to, ``local`` for one of
            its own on this machine, or the host and port of another's head.
        workers: runs at a time; None takes as many as there are cores.

    Raises:
        InputError: Ray is not installed, or there is no such cluster.
    """

    def __init__(self, address: str, workers: int | None = None) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing about a user's runs leaves their machines
        try:
            import ray
            import ray.util.scheduling_strategies
        except ImportError as error:
            raise InputError("--ray: Ray is not installed; pip install 'v3d-torch[ray]'") from error
        try:
            _knock_at(address)
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(
                f"--ray {address}: there is no such cluster ({_first_line(error)}); start one with ray start --head, or"
                " give local"
            ) from error
        self._ray = ray
        self.workers = workers

    def __call__(self, jobs: Sequence[Job], stop: Event) -> Generator[JobProgress | Finished]:
        """See `Executor`."""
        ray = self._ray
        here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=False
        )
        board = ray.remote(num_cpus=0, scheduling_strategy=here)(_Board).remote()  # no other machine's end is its end
        run = ray.remote(
            num_cpus=1,
            max_retries=0,
            max_calls=1,  # the next job gets a new process
            runtime_env={"env_vars": THREADS},
        )(_run)
        waiting = iter(range(len(jobs)))
        pending: dict[Any, int] = {}
        told = False
        try:
            while True:
                if not stop.is_set():
                    free = None if self.workers is None else self.workers - len(pending)
                    pending |= {run.remote(jobs[index], index, board): index for index in islice(waiting, free)}
                elif not told:
                    told = True
                    for reference in pending:
                        ray.cancel(reference)
                if not pending:
                    return
                ended, _ = ray.wait(list(pending), timeout=_LOOK)
                for index, frames in ray.get(board.news.remote()).items():
                    if index in pending.values():  # a note may come after its job's end
                        yield JobProgress(jobs[index], frames)
                for reference in ended:
                    job = jobs[pending.pop(reference)]
                    try:
                        yield Finished(job, ray.get(reference))
                    except ray.exceptions.TaskCancelledError:  # before it was started
                        continue
                    except ray.exceptions.RayError as error:
                        yield Finished(job, f"its process or machine failed ({_first_line(error)})")
        except ray.exceptions.RayError as error:
            raise InputError(
                f"the Ray cluster was lost ({_first_line(error)}); the same command with --resume goes on"
            ) from error
        finally:
            ray.shutdown()


def _knock_at(address: str) -> None:
    """Raise OSError where nobody listens at a host and port: Ray itself would try for a quarter of an hour."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if port.isdecimal():
        socket.create_connection((host, int(port)), timeout=5.0).close()


def _first_line(error: Exception) -> str:
    """What Ray says of an error, without the pages that follow."""
    said = str(getattr(error, "cause", None) or error).strip()
    return said.splitlines()[0] if said else type(error).__name__


class _Board:
    """Where the runs write how far they are; an actor."""

    def __init__(self) -> None:
        self._frames: dict[int, int] = {}

    def report(self, index: int, frames: int) -> None:
        """Note the frames done of a job."""
        self._frames[index] = frames

    def news(self) -> dict[int, int]:
        """Frames done of the jobs that have reported since the last call."""
        news, self._frames = self._frames, {}
        return news


def _run(job: Job, index: int, board: Any) -> str | None:
    """The whole life of a process."""
    with interrupts_between_frames() as cancelled:  # Ray cancels a task as Ctrl-C does

        def report(frames: int) -> None:
            board.report.remote(index, frames)  # nobody waits: a task that does gives its core to another one
            if cancelled.is_set():
                raise KeyboardInterrupt

        report(0)
        return run_job(job, report)
