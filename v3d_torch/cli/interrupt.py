"""Report of Ctrl-C, SIGTERM and SIGHUP; it imports nothing slow, so that it is ready before slow imports."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from v3d_torch.runtime.hangup import handled_hangup, leave_terminal


def interrupt_on_termination() -> None:
    """Make SIGTERM and SIGHUP raise the exception of Ctrl-C.

    A system or a container ends its processes with SIGTERM, and SIGHUP tells that the terminal is lost. A command then
    removes what it has half written, and reports the interruption.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    for each in handled_hangup():
        signal.signal(each, _end_without_terminal)


def _end_without_terminal(signum: int, frame: FrameType | None) -> None:
    """Raise the exception of Ctrl-C once: the system and the shell both send SIGHUP."""
    signal.signal(signum, signal.SIG_IGN)
    leave_terminal()
    raise KeyboardInterrupt


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Report Ctrl-C as one line on stderr, and exit with code 2."""
    try:
        yield
    except KeyboardInterrupt:
        print("error: interrupted before the results were written", file=sys.stderr)
        sys.exit(2)
