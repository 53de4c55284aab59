"""Errors of commands: one line on stderr, exit code 2."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from v3d_torch.errors import DepthScaleWarning, GroundTruthWarning, V3DError


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Print an error that the user can act on as one line on stderr, and exit with code 2."""
    try:
        with warnings.catch_warnings():
            for reported in (GroundTruthWarning, DepthScaleWarning):  # by the commands, as errors and notes
                warnings.simplefilter("ignore", reported)
            yield
    except V3DError as error:
        print(f"error: {_printable(error)}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:  # of a path given by the user: too long a name, a folder without permission
        path, reason = error.filename or "a file", error.strerror or error
        print(f"error: {_printable(path)}: cannot be used ({reason}); check path and permissions", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("error: interrupted before the results were written", file=sys.stderr)
        sys.exit(2)


def _printable(value: object) -> str:
    """Return a text in one line; file names and contents in it can hold control characters."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(value))
