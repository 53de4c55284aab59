"""Test cases of the corpus: how to damage a small sequence, and how its run must end."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from helpers.corpus.base import FRAMES


@dataclass
class Place:
    """Folder and command line of one case.

    Attributes:
        root: Empty folder, the working directory of the command. The intact sequence is in its subfolder ``seq``.
        seq: Value of ``--seq``.
        options: Other options of the command.
    """

    root: Path
    seq: str = ""
    options: list[str] = field(default_factory=lambda: ["--segmenter", "none"])

    @property
    def folder(self) -> Path:
        """Folder of the sequence."""
        return self.root / "seq"

    @property
    def out(self) -> Path:
        """Folder of the results, the value of ``--out``. It does not exist before the run."""
        return self.root / "out"

    def filled(self, text: str) -> str:
        """Replace ``{seq}``, ``{out}`` and ``{root}`` in a text by the paths."""
        return text.replace("{seq}", str(self.folder)).replace("{out}", str(self.out)).replace("{root}", str(self.root))


Make = Callable[[Place], None]
"""Function that damages the sequence, or changes the command line, of a case."""


@dataclass(frozen=True)
class Right:
    """Expected end of a run: exit code 0 and a correct result."""

    frames: int = FRAMES
    """Number of poses in the trajectory."""
    lost: int = 0
    """Number of frames with lost tracking."""
    ate: float | None = 0.005
    """Upper limit of the absolute trajectory error (rmse), metres; None if the run has no scores."""
    note: str = ""
    """Text in the output of the command."""


@dataclass(frozen=True)
class Says:
    """Expected end of a run: exit code 2 and a single error message on stderr."""

    sentence: str
    """Whole text after ``error: ``. ``{seq}``, ``{out}`` and ``{root}`` stand for paths, ``...`` for any text."""
    kept: int | None = None
    """Number of poses in the results; None if the run ends before any results are written."""

    def fits(self, text: str, place: Place) -> bool:
        """Check whether a message is the expected one."""
        parts = (re.escape(part) for part in place.filled(self.sentence).split("..."))
        return re.fullmatch(".*".join(parts), text) is not None


@dataclass(frozen=True)
class Case:
    """A damaged sequence and the expected end of its run."""

    name: str
    """Short description."""
    make: Make
    """Function that damages the sequence or changes the command line."""
    ends: Right | Says
    """Expected end of the run."""
    during: Callable[[Place], AbstractContextManager[object]] = lambda place: nullcontext()
    """Function that returns a context manager around the run."""


# ---------------------------------------------------------------- ways to damage a sequence


def edit(file: str, change: Callable[[bytes], bytes]) -> Make:
    """Change the content of a file of the sequence."""

    def make(place: Place) -> None:
        path = place.folder / file
        path.write_bytes(change(path.read_bytes()))

    return make


def write(file: str, content: str | bytes) -> Make:
    """Write a file of the sequence; path placeholders in a text are replaced."""

    def make(place: Place) -> None:
        path = place.folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else place.filled(content).encode())

    return make


def remove(*files: str) -> Make:
    """Remove files of the sequence."""

    def make(place: Place) -> None:
        for file in files:
            (place.folder / file).unlink()

    return make


def options(*more: str) -> Make:
    """Add command line options; path placeholders are replaced."""

    def make(place: Place) -> None:
        place.options += [place.filled(option) for option in more]

    return make


def only(*given: str) -> Make:
    """Replace the default command line options; path placeholders are replaced."""

    def make(place: Place) -> None:
        place.options = [place.filled(option) for option in given]

    return make


def seq(name: str) -> Make:
    """Set the value of ``--seq``; path placeholders are replaced."""

    def make(place: Place) -> None:
        place.seq = place.filled(name)

    return make


def all_of(*makes: Make) -> Make:
    """Combine several changes, applied in this order."""

    def make(place: Place) -> None:
        for each in makes:
            each(place)

    return make


def replaced(old: str, new: str) -> Callable[[bytes], bytes]:
    """Return a change that replaces a text."""
    return lambda content: content.replace(old.encode(), new.encode())


def half(content: bytes) -> bytes:
    """First half of a file, as an interrupted copy leaves it."""
    return content[: len(content) // 2]
