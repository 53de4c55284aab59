"""Paths given by users, with ``~`` for the home folder, and the cache folder.

Shells expand ``~`` in ``--out ~/x``, but not in ``--out=~/x``, in environment variables in quotes, or in Python.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

StrPath = str | os.PathLike[str]
"""A path as a string or as a path object."""


def expand_user(path: StrPath) -> Path:
    """Expand a leading ``~`` to the home folder; a path of an unknown user stays unchanged."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def cache_dir() -> Path:
    """Return the cache folder for downloads and generated files: ``$V3D_CACHE``, else the platform's user cache."""
    return expand_user(os.environ.get("V3D_CACHE") or user_cache_path("v3d_torch"))


def expand_user_paths(command: Callable[..., None]) -> Callable[..., None]:
    """Decorate a command so that a leading ``~`` is expanded in all its options of type `Path`."""

    @wraps(command)
    def expanded(**options: Any) -> None:
        command(**{name: expand_user(value) if isinstance(value, Path) else value for name, value in options.items()})

    return expanded
