"""Start of the program, without imports that take time, so that Ctrl-C is reported from the first moment."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

_INTERRUPTED = 130
"""Exit code of Typer after Ctrl-C, without a message."""


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Report Ctrl-C as one line on stderr, and exit with code 2."""
    try:
        yield
    except KeyboardInterrupt:
        print("error: interrupted before the results were written", file=sys.stderr)
        sys.exit(2)


def main() -> None:
    """Import the commands, and call that of the command line."""
    with exit_on_interrupt():
        from v3d_torch.cli.commands import app

        try:
            app(prog_name="v3d-torch")
        except SystemExit as end:
            if end.code == _INTERRUPTED:
                raise KeyboardInterrupt from end
            raise
