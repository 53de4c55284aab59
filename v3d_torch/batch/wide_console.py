"""Console for the tables of batches."""

from __future__ import annotations

import sys

from rich.console import Console


def wide_console() -> Console:
    """Return a console for wide tables: 200 columns if the output is not a terminal, instead of 80."""
    return Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 200)
