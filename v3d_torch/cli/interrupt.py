"""Report of Ctrl-C; it imports nothing of the package, so that it is ready before the imports that take time."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Report Ctrl-C as one line on stderr, and exit with code 2."""
    try:
        yield
    except KeyboardInterrupt:
        print("error: interrupted before the results were written", file=sys.stderr)
        sys.exit(2)
