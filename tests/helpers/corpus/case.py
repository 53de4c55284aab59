"""What a case is: a way to break a small sequence, and how its run has to end."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from helpers.corpus.base import FRAMES


@dataclass
class Place:
    """Where a case is made and run.

    Attributes:
        root: an empty folder, in which the command runs; ``seq`` in it holds a whole sequence to be broken.
        seq: what is given as ``--seq``.
        options: further options of the command.
    """

    root: Path
    seq: str = ""
    options: list[str] = field(default_factory=lambda: ["--segmenter", "none"])

    @property
    def folder(self) -> Path:
        """Of the sequence."""
        return self.root / "seq"

    @property
    def out(self) -> Path:
        """Given as ``--out``, not there yet."""
        return self.root / "out"

    def filled(self, text: str) -> str:
        """A text with ``{seq}``, ``{out}`` and ``{root}`` replaced by the paths."""
        return text.replace("{seq}", str(self.folder)).replace("{out}", str(self.out)).replace("{root}", str(self.root))


Make = Callable[[Place], None]
"""Breaks what is in a place."""


@dataclass(frozen=True)
class Right:
    """The run ends well, and its result is right.

    Attributes:
        frames: poses in the trajectory.
        lost: frames that were not found.
        ate: more than the error against ground truth may be, metres; None where there is no ground truth.
        note: what is said beside the scores.
    """

    frames: int = FRAMES
    lost: int = 0
    ate: float | None = 0.005
    note: str = ""


@dataclass(frozen=True)
class Says:
    """The run ends with exit code 2 and one sentence on stderr.

    Attributes:
        sentence: all of it behind ``error: ``; ``{seq}``, ``{out}`` and ``{root}`` are paths, ``...`` is any text.
        kept: poses that are in the results all the same; None where it ended before there were any results.
    """

    sentence: str
    kept: int | None = None

    def fits(self, text: str, place: Place) -> bool:
        """Whether a sentence is this one."""
        parts = (re.escape(part) for part in place.filled(self.sentence).split("..."))
        return re.fullmatch(".*".join(parts), text) is not None


@dataclass(frozen=True)
class Case:
    """A way to break a sequence.

    Attributes:
        name: in a few words.
        make: does it.
        ends: how the run has to end.
        during: what is the case around the run.
    """

    name: str
    make: Make
    ends: Right | Says
    during: Callable[[Place], AbstractContextManager[object]] = lambda place: nullcontext()


# ---------------------------------------------------------------- ways to break something


def edit(file: str, change: Callable[[bytes], bytes]) -> Make:
    """Change a file of the sequence."""

    def make(place: Place) -> None:
        path = place.folder / file
        path.write_bytes(change(path.read_bytes()))

    return make


def write(file: str, content: str | bytes) -> Make:
    """Write a file of the sequence; paths in a text are filled in."""

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
    """Give further options; paths in them are filled in."""

    def make(place: Place) -> None:
        place.options += [place.filled(option) for option in more]

    return make


def only(*given: str) -> Make:
    """Give these options instead of the usual ones; paths in them are filled in."""

    def make(place: Place) -> None:
        place.options = [place.filled(option) for option in given]

    return make


def seq(name: str) -> Make:
    """Give something else as the sequence; paths in it are filled in."""

    def make(place: Place) -> None:
        place.seq = place.filled(name)

    return make


def all_of(*makes: Make) -> Make:
    """One after the other."""

    def make(place: Place) -> None:
        for each in makes:
            each(place)

    return make


def replaced(old: str, new: str) -> Callable[[bytes], bytes]:
    """A change of a text."""
    return lambda content: content.replace(old.encode(), new.encode())


def half(content: bytes) -> bytes:
    """The first half of a file, as a copy that broke off leaves it."""
    return content[: len(content) // 2]
