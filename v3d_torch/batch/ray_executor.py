"""Executor that runs the jobs of a batch on a Ray cluster."""

from __future__ import annotations

import logging
import os
import socket
from collections import deque
from collections.abc import Generator, Sequence
from threading import Event
from typing import Any

from v3d_torch.batch.executor import (
    ONE_THREAD_ENVIRONMENT,
    BatchEvent,
    JobFinished,
    JobProgress,
    JobRepeated,
    report_lost_process,
)
from v3d_torch.batch.job import Job
from v3d_torch.batch.progress_board import ProgressBoard
from v3d_torch.batch.run_job import run_job
from v3d_torch.errors import InputError
from v3d_torch.io.text import first_line
from v3d_torch.runs.interrupts import interrupts_between_frames

_POLL_INTERVAL = 0.2
"""Time between two polls of the progress, seconds: often enough for a progress bar, and cheap for the cluster."""

_CONNECT_TIMEOUT = 5.0
"""Maximum wait for the head of a cluster to accept a connection, seconds; a working network takes less."""


class RayExecutor:
    """An `Executor` that runs each job in a process of a Ray cluster, with one core and one thread.

    The package has to be installed on all machines, and they have to share the folders of the results and of the
    sequences. A job whose process or machine dies is run once more, from its last checkpoint: machines of a cluster can
    fail or be taken away, but a job that dies twice probably needs more memory than there is.

    Args:
        address: Address of the cluster for ``ray.init``: ``auto`` for the cluster of this machine, ``local`` for a new
            cluster on this machine, or host and port of the head of another cluster.
        workers: Number of jobs at a time; None for one job per core of the cluster.

    Raises:
        InputError: If Ray is not installed, or if there is no such cluster.
    """

    def __init__(self, address: str, workers: int | None = None) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would send usage statistics
        try:
            import ray
            import ray.util.scheduling_strategies
        except ImportError as error:
            raise InputError("--ray: Ray is not installed; pip install 'v3d-torch[ray]'") from error
        try:
            _check_connection(address)
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(
                f"--ray {address}: no Ray cluster found ({_describe(error)}); start one with ray start --head, or"
                " use --ray local"
            ) from error
        self._ray = ray
        self.workers = workers

    def __call__(self, jobs: Sequence[Job], stop: Event) -> Generator[BatchEvent]:
        """Run jobs; see `Executor`."""
        ray = self._ray
        this_machine = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=False
        )
        # The board is on this machine, so that it survives the end of any other machine.
        board = ray.remote(num_cpus=0, scheduling_strategy=this_machine)(ProgressBoard).remote()
        run = ray.remote(
            num_cpus=1,
            max_retries=0,
            max_calls=1,  # a new process for each job
            runtime_env={"env_vars": ONE_THREAD_ENVIRONMENT},
        )(_task)
        waiting = deque(range(len(jobs)))
        pending: dict[Any, int] = {}
        repeated: set[int] = set()
        cancelled = False
        try:
            while True:
                if not stop.is_set():
                    while waiting and (self.workers is None or len(pending) < self.workers):
                        index = waiting.popleft()
                        pending[run.remote(jobs[index], index, board)] = index
                elif not cancelled:
                    cancelled = True
                    for task in pending:
                        ray.cancel(task)
                if not pending:
                    return
                ended, _ = ray.wait(list(pending), timeout=_POLL_INTERVAL)
                for index, frames in ray.get(board.take.remote()).items():
                    if index in pending.values():  # a report can arrive after the end of its job
                        yield JobProgress(jobs[index], frames)
                for task in ended:
                    index = pending.pop(task)
                    job = jobs[index]
                    try:
                        yield JobFinished(job, ray.get(task))
                    except ray.exceptions.TaskCancelledError:  # before it started
                        continue
                    except ray.exceptions.RayError as error:
                        reason = f"its process or machine failed ({_describe(error)})"
                        if index in repeated or stop.is_set():
                            yield report_lost_process(job, reason)
                        else:
                            repeated.add(index)
                            waiting.appendleft(index)
                            yield JobRepeated(job, reason)
        except ray.exceptions.RayError as error:
            raise InputError(
                f"connection to the Ray cluster lost ({_describe(error)}); repeat the command with --resume to continue"
            ) from error
        finally:
            ray.shutdown()


def _check_connection(address: str) -> None:
    """Raise OSError if a host and port do not accept connections: Ray itself would retry for many minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if port.isdecimal():
        socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT).close()


def _describe(error: Exception) -> str:
    """Return the first line of an error of Ray, or of its cause in the task."""
    return first_line(getattr(error, "cause", None) or error)


def _task(job: Job, index: int, board: Any) -> str | None:
    """Run a job and report its progress; main function of a Ray task."""
    with interrupts_between_frames() as cancelled:  # Ray cancels a task with the signal of Ctrl-C

        def report_progress(frames: int) -> None:
            board.report.remote(index, frames)  # not awaited, because a waiting task yields its core to another task
            if cancelled.is_set():
                raise KeyboardInterrupt

        report_progress(0)
        return run_job(job, report_progress)
