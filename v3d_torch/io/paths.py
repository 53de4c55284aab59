"""``~`` in paths: shells put the home folder in its place in ``--out ~/x``, but not in ``--out=~/x``, nor in Python."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from v3d_torch.io.files import StrPath  # whose libraries take long to load, and help is instant


def expand_user(path: StrPath) -> Path:
    """The path, from the user's home where it begins with ``~``; as it is where that is somebody not known here."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def expand_user_paths(command: Callable[..., None]) -> Callable[..., None]:
    """Let the paths among the options of a command begin with ``~``."""

    @wraps(command)
    def expanded(**options: Any) -> None:
        command(**{name: expand_user(value) if isinstance(value, Path) else value for name, value in options.items()})

    return expanded
