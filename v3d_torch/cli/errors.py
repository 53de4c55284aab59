"""Errors of commands: one line on stderr, exit code 2."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from v3d_torch.errors import DepthScaleWarning, GroundTruthWarning, V3DError


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Print an error that a user can fix as one line on stderr, and exit with code 2."""
    try:
        with warnings.catch_warnings():
            for reported in (GroundTruthWarning, DepthScaleWarning):  # by the commands, as errors and notes
                warnings.simplefilter("ignore", reported)
            yield
    except V3DError as error:
        print(f"error: {_printable(error)}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:  # of a path given by the user, such as a folder without permission or too long a name
        path, reason = error.filename or "a file", error.strerror or error
        print(f"error: {_printable(path)}: cannot be used ({reason}); check path and permissions", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("error: interrupted before the results were written", file=sys.stderr)
        sys.exit(2)


def _printable(value: object) -> str:
    """Return a text in one line, without the control characters that file names and contents can have."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(value))
