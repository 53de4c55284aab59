"""Loss of the terminal, as of a dropped ssh session: its signal, and the output to a terminal that is gone.

It imports nothing slow, because programs use it before their imports.
"""

from __future__ import annotations

import os
import signal
import stat
import sys

HANGUP: tuple[signal.Signals, ...] = () if sys.platform == "win32" else (signal.SIGHUP,)
"""Signal of a lost terminal; none on Windows."""

_OUTPUTS = (1, 2)
"""File descriptors of the standard output and the standard error."""


def handled_hangup() -> tuple[signal.Signals, ...]:
    """Return the signal of a lost terminal unless it is ignored: ``nohup`` asks a program to go on without terminal."""
    return tuple(each for each in HANGUP if signal.getsignal(each) != signal.SIG_IGN)


def leave_terminal() -> None:
    """Redirect output to a terminal to `os.devnull`, because writing to a lost terminal raises an error.

    `os.isatty` is false for a lost terminal. Therefore every character device is redirected; files and pipes are not.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for output in _OUTPUTS:
        if stat.S_ISCHR(os.fstat(output).st_mode):
            os.dup2(nowhere, output)
    os.close(nowhere)
