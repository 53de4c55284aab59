"""Names of sequences that come from paths, and names of folders that come from sequences."""

from __future__ import annotations

from pathlib import Path


def path_label(path: Path) -> str:
    """Return the name of a folder, or that of a file without its suffix: a dot in the name of a folder is no suffix."""
    resolved = path.resolve()
    return resolved.name if resolved.is_dir() else resolved.stem


def folder_name(name: str) -> str:
    """Return the name of a sequence as the name of one folder: ``fr3/w/xyz`` and ``demo:sitting`` are no folders."""
    return name.replace("/", "_").replace(":", "_")
