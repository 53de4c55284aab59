"""Runs on one machine, each in a process of its own."""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Event

from v3d_torch.batch.executor import THREADS, Finished, JobProgress
from v3d_torch.batch.job import Job
from v3d_torch.batch.job_process import run_job

_LOOK = 0.2
"""Longest time until a wish to stop is seen, seconds."""


class Processes:
    """An `Executor` on this machine.

    Args:
        workers: runs at a time. More than one get no threads beyond their own (`THREADS`).
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def __call__(self, jobs: Sequence[Job], stop: Event) -> Generator[JobProgress | Finished]:
        """See `Executor`."""
        waiting = deque(jobs)
        running: dict[Connection, tuple[Job, BaseProcess]] = {}
        told = False
        try:
            while running or (waiting and not stop.is_set()):
                while waiting and len(running) < self.workers and not stop.is_set():
                    job = waiting.popleft()
                    connection, process = self._start(job)
                    running[connection] = job, process
                    yield JobProgress(job, 0)
                if stop.is_set() and not told:
                    told = True
                    for connection in running:
                        with suppress(OSError):  # it has ended by itself
                            connection.send("stop")
                ready = wait(list(running), timeout=_LOOK)
                for connection in [connection for connection in running if connection in ready]:
                    job, process = running[connection]
                    event = _event(job, process, connection)
                    if isinstance(event, Finished):
                        del running[connection]
                    yield event
        finally:
            for _, process in running.values():
                process.kill()
                process.join()

    def _start(self, job: Job) -> tuple[Connection, BaseProcess]:
        ours, theirs = _SPAWN.Pipe()
        process = _SPAWN.Process(target=_work, args=(job, theirs), name=str(job))
        with _environment(THREADS if self.workers > 1 else {}), _deaf():
            process.start()
        theirs.close()  # so that the end of the process is the end of the pipe
        return ours, process


_SPAWN = get_context("spawn")


def _event(job: Job, process: BaseProcess, connection: Connection) -> JobProgress | Finished:
    """What a process has to say, or that it died without a word."""
    try:
        message: int | tuple[str | None] = connection.recv()
    except (EOFError, OSError):
        process.join()
        return Finished(job, _how_it_died(process))
    if isinstance(message, int):
        return JobProgress(job, message)
    process.join()
    return Finished(job, *message)


def _how_it_died(process: BaseProcess) -> str:
    code = process.exitcode or 0
    if code >= 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name
    hint = ", as the system does when memory runs out" if name == "SIGKILL" else ""
    return f"its process was killed by {name}{hint}"


def _work(job: Job, connection: Connection) -> None:
    """The whole life of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where `_deaf` does nothing
    _speak_into(job.folder / "run.log")

    def report(frames: int) -> None:
        try:
            connection.send(frames)
            stopped = connection.poll()
        except OSError:  # nobody listens any more
            stopped = True
        if stopped:
            raise KeyboardInterrupt

    failure = run_job(job, report)
    with suppress(OSError):
        connection.send((failure,))


def _speak_into(path: Path) -> None:
    """Send what libraries print, and a crash's last words, into the log instead of over the bars."""
    with suppress(OSError):  # the run itself tells that it cannot write
        path.parent.mkdir(parents=True, exist_ok=True)
        log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.close(log)
    faulthandler.enable()


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set variables for the processes that are started in the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _deaf() -> Iterator[None]:
    """Keep Ctrl-C, which reaches all processes of a terminal, from those started in the block: they are told to stop.

    One that comes within the block takes effect after it.
    """
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # starting with the first process, it would let signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
