"""Pickled code: an object whose reading has an effect that a test sees."""

from __future__ import annotations

from pathlib import Path


class CreatesFile:
    """Object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.path,))
