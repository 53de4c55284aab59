"""Report of Ctrl-C and SIGTERM; it imports nothing of the package, so that it is ready before slow imports."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def interrupt_on_termination() -> None:
    """Make SIGTERM, with which a system or a container ends its processes, raise the exception of Ctrl-C.

    A command then removes what it has half written, and reports the interruption.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Report Ctrl-C as one line on stderr, and exit with code 2."""
    try:
        yield
    except KeyboardInterrupt:
        print("error: interrupted before the results were written", file=sys.stderr)
        sys.exit(2)
