"""Errors of commands: one line on stderr, exit code 2."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from v3d_torch.cli.interrupt import exit_on_interrupt
from v3d_torch.errors import DepthScaleWarning, GroundTruthWarning, V3DError
from v3d_torch.io.text import printable


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Print an error that a user can fix as one line on stderr, and exit with code 2."""
    try:
        with exit_on_interrupt(), warnings.catch_warnings():
            for reported in (GroundTruthWarning, DepthScaleWarning):  # by the commands, as errors and notes
                warnings.simplefilter("ignore", reported)
            yield
    except V3DError as error:
        print(f"error: {printable(error)}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:  # of a path given by the user, such as a folder without permission or too long a name
        reason = error.strerror or error
        if error.filename is None:  # of an open file, such as the standard output on a full disk
            message = f"reading or writing failed ({reason}); check the disk, and where the output goes"
        else:
            message = f"{error.filename}: cannot be used ({reason}); check path and permissions"
        print(f"error: {printable(message)}", file=sys.stderr)
        sys.exit(2)
