"""Content of folders."""

from __future__ import annotations

from pathlib import Path


def names_in(folder: Path) -> list[str]:
    """Return the sorted names of the files and folders in a folder."""
    return sorted(entry.name for entry in folder.iterdir())
