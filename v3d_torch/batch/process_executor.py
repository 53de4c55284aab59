"""Executor that runs the jobs of a batch on this machine."""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import tempfile
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_all_start_methods, get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from v3d_torch.batch.executor import ONE_THREAD_ENVIRONMENT, JobFinished, JobProgress, report_lost_process
from v3d_torch.batch.job import Job
from v3d_torch.batch.run_job import run_job
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.log import remove_link
from v3d_torch.runtime.hangup import HANGUP
from v3d_torch.runtime.imports import import_environment

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

_STOP_LATENCY = 0.2
"""Interval of the checks for a stop request, seconds: the delay is hardly noticeable, and the checks take no time."""

_MAX_SOCKET_PATH = 103
"""Maximum length of the path of a socket, on the system with the lowest limit (macOS)."""

_SOCKET_NAME = "/pymp-01234567/listener-01234567"
"""Form of the path of a fork server's socket in the temporary folder."""

_OF_TERMINAL = (signal.SIGINT, *HANGUP)
"""Signals that a terminal sends to all its processes."""

_NO_LINKS: int = getattr(os, "O_NOFOLLOW", 0)
"""Flag of files that are opened without following a link; Windows has none."""


class ProcessExecutor:
    """An `Executor` that runs each job in a process on this machine.

    Args:
        workers: Number of jobs at a time. If it is greater than 1, each job has one thread (`ONE_THREAD_ENVIRONMENT`).
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def __call__(self, jobs: Sequence[Job], stop: Event) -> Generator[JobProgress | JobFinished]:
        """Run jobs; see `Executor`."""
        waiting = deque(jobs)
        running: dict[Connection, tuple[Job, BaseProcess]] = {}
        stop_sent = False
        try:
            while running or (waiting and not stop.is_set()):
                while waiting and len(running) < self.workers and not stop.is_set():
                    job = waiting.popleft()
                    connection, process = self._start(job)
                    running[connection] = job, process
                    yield JobProgress(job, 0)
                if stop.is_set() and not stop_sent:
                    stop_sent = True
                    for connection in running:
                        with suppress(OSError):  # the job has just ended
                            connection.send("stop")
                ready = wait(list(running), timeout=_STOP_LATENCY)
                for connection in [connection for connection in running if connection in ready]:
                    job, process = running[connection]
                    event = _receive_event(job, process, connection)
                    if isinstance(event, JobFinished):
                        del running[connection]
                    yield event
        finally:
            for _, process in running.values():
                process.kill()
                process.join()

    def _start(self, job: Job) -> tuple[Connection, BaseProcess]:
        context = start_method()
        parent_end, child_end = context.Pipe()
        variables = ONE_THREAD_ENVIRONMENT if self.workers > 1 else {}
        arguments = job, child_end, os.environ | variables  # programs that the job starts have their own import path
        with _environment(import_environment() | variables), _block_interrupts():
            process = context.Process(target=_process_main, args=arguments, name=str(job))
            process.start()
        child_end.close()  # so that the pipe ends when the process ends
        return parent_end, process


def _receive_event(job: Job, process: BaseProcess, connection: Connection) -> JobProgress | JobFinished:
    """Receive the next message of a process; a closed pipe means that the process died."""
    try:
        message: int | tuple[str | None] = connection.recv()
    except (EOFError, OSError):
        process.join()
        return report_lost_process(job, _describe_exit(process))
    if isinstance(message, int):
        return JobProgress(job, message)
    process.join()
    return JobFinished(job, *message)


def start_method() -> ForkServerContext | SpawnContext:
    """Return how jobs are started: as forks of a server that has only imported the package and loaded its kernels.

    Windows has no forks, and the path of the server's socket, in the temporary folder, has a maximum length. There,
    jobs are new interpreters.
    """
    is_short = len(tempfile.gettempdir()) + len(_SOCKET_NAME) <= _MAX_SOCKET_PATH
    if not is_short or "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload(["v3d_torch.batch.fork_server"])
    return context


def _describe_exit(process: BaseProcess) -> str:
    code = process.exitcode or 0
    if code >= 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name
    hint = ", which the system does when memory runs out" if name == "SIGKILL" else ""
    return f"its process was killed by {name}{hint}"


def _process_main(job: Job, connection: Connection, environment: Mapping[str, str]) -> None:
    """Run a job and send its progress and outcome; main function of the process."""
    os.environ.clear()  # the fork server has the environment of its start
    os.environ.update(environment)
    for each in _OF_TERMINAL:
        signal.signal(each, signal.SIG_IGN)  # for systems on which `_block_interrupts` has no effect
    _redirect_output(job.folder / RunFile.LOG)

    def report_progress(frames: int) -> None:
        try:
            connection.send(frames)
            stop = connection.poll()
        except OSError:  # the parent process has ended
            stop = True
        if stop:
            raise KeyboardInterrupt

    failure = run_job(job, report_progress)
    with suppress(OSError):
        connection.send((failure,))


def _redirect_output(path: Path) -> None:
    """Append the output of libraries and the traceback of a crash to the log, so that the bars stay readable."""
    with suppress(OSError):  # `run_job` reports a folder that is not writable
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_link(path)
        log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | _NO_LINKS, 0o666)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.close(log)
    faulthandler.enable()


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started in the block."""
    previous = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Block the signals of a terminal for the processes that are started in the block; the parent asks them to stop.

    A terminal sends Ctrl-C, and its loss, to all its processes. A signal within the block takes effect after the block.
    """
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # if it started with the first process, it would unblock the signal
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
