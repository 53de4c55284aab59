"""Output of a line that can contain names."""

from __future__ import annotations

from rich.console import Console

from v3d_torch.io.text import printable


def print_line(console: Console, text: str) -> None:
    """Print a text in one line as it is: names of files and folders can contain brackets and control characters.

    Args:
        console: Console to print to.
        text: Text without markup.
    """
    console.print(printable(text), markup=False)
