"""The run command in forks of a process that has imported the package, which takes seconds in a new interpreter."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory

from helpers.commands import environment
from v3d_torch.batch.process_executor import start_method


def start_forked(
    *arguments: str | Path,
    cwd: Path,
    output: Path = Path(os.devnull),
    before: Callable[[], object] | None = None,
    **variables: str,
) -> BaseProcess:
    """Start the command in a process of its own, which has an exit code and can be killed.

    Args:
        arguments: Arguments of the command.
        cwd: Working directory.
        output: Folder for the files ``stdout`` and ``stderr`` of the process; by default, its output is lost.
        before: Function of a module in `helpers` that the process calls before the command.
        variables: Changes of the environment.
    """
    given = list(map(str, arguments)), cwd, output, before, environment(**variables)
    process = start_method().Process(target=_run, args=given)
    process.start()
    return process


def call_forked(*arguments: str | Path, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own until its end; see `start_forked`."""
    with TemporaryDirectory() as folder:
        process = start_forked(*arguments, cwd=cwd, output=Path(folder), **variables)
        process.join(timeout=300)
        assert process.exitcode is not None, "the command did not end"
        stdout, stderr = ((Path(folder) / name).read_text() for name in ("stdout", "stderr"))
    return subprocess.CompletedProcess(arguments, process.exitcode, stdout, stderr)


def _run(
    arguments: list[str],
    cwd: Path,
    output: Path,
    before: Callable[[], object] | None,
    environment: Mapping[str, str],
) -> None:
    """Run the command; main function of the process."""
    from v3d_torch.cli import run

    os.environ.clear()
    os.environ.update(environment)
    os.chdir(cwd)
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        path = output / name if output.is_dir() else output
        file = os.open(path, os.O_WRONLY | os.O_CREAT)
        os.dup2(file, descriptor)
        os.close(file)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGHUP})  # blocked if a batch started the server
    if before is not None:
        before()
    run.app(arguments)
