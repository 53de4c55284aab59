"""Test cases of the corpus: how to damage a small sequence, and how its run must end."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from helpers.corpus.base import FRAMES


@dataclass
class Workspace:
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

    def fill_paths(self, text: str) -> str:
        """Replace ``{seq}``, ``{out}`` and ``{root}`` in a text by the paths."""
        return text.replace("{seq}", str(self.folder)).replace("{out}", str(self.out)).replace("{root}", str(self.root))


Damage = Callable[[Workspace], None]
"""Function that damages the sequence, or changes the command line, of a case."""


@dataclass(frozen=True)
class Succeeds:
    """Expected end of a run: exit code 0 and a correct result."""

    frames: int = FRAMES
    """Number of poses in the trajectory."""
    lost: int = 0
    """Number of frames with lost tracking."""
    max_ate: float | None = 0.005
    """Upper limit of the absolute trajectory error (rmse), metres; None if the run has no scores."""
    note: str = ""
    """Text in the output of the command."""


@dataclass(frozen=True)
class Fails:
    """Expected end of a run: exit code 2 and a single error message on stderr."""

    message: str
    """Whole text after ``error: ``. ``{seq}``, ``{out}`` and ``{root}`` stand for paths, ``...`` for any text."""
    saved_poses: int | None = None
    """Number of poses in the results; None if the run ends before any results are written."""

    def fits(self, text: str, place: Workspace) -> bool:
        """Check whether a message is the expected one."""
        parts = (re.escape(part) for part in place.fill_paths(self.message).split("..."))
        return re.fullmatch(".*".join(parts), text) is not None


def fails_at_frame(frame: int, message: str) -> Fails:
    """Return the expected end of a run that fails at a frame; the results of the frames before are written."""
    resume = "; resume with --resume {out}" if frame else ""
    end = f" (the results of the {frame} frames before are in {{out}}{resume})"
    return Fails(message + end, saved_poses=frame)


def fails_after_run(message: str) -> Fails:
    """Return the expected end of a run that fails after its last frame; all results are written."""
    return Fails(message + " (the results are in {out})", saved_poses=FRAMES)


@dataclass(frozen=True)
class Case:
    """A damaged sequence and the expected end of its run."""

    name: str
    """Short description."""
    damage: Damage
    """Function that damages the sequence or changes the command line."""
    expected: Succeeds | Fails
    """Expected end of the run."""
    context: Callable[[Workspace], AbstractContextManager[object]] = lambda place: nullcontext()
    """Function that returns a context manager around the run."""


# ---------------------------------------------------------------- ways to damage a sequence


def edit(file: str, change: Callable[[bytes], bytes]) -> Damage:
    """Change the content of a file of the sequence."""

    def make(place: Workspace) -> None:
        path = place.folder / file
        path.write_bytes(change(path.read_bytes()))

    return make


def write(file: str, content: str | bytes) -> Damage:
    """Write a file of the sequence; path placeholders in a text are replaced."""

    def make(place: Workspace) -> None:
        path = place.folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else place.fill_paths(content).encode())

    return make


def remove(*files: str) -> Damage:
    """Remove files of the sequence."""

    def make(place: Workspace) -> None:
        for file in files:
            (place.folder / file).unlink()

    return make


def add_options(*more: str) -> Damage:
    """Add command line options; path placeholders are replaced."""

    def make(place: Workspace) -> None:
        place.options += [place.fill_paths(option) for option in more]

    return make


def replace_options(*given: str) -> Damage:
    """Replace the default command line options; path placeholders are replaced."""

    def make(place: Workspace) -> None:
        place.options = [place.fill_paths(option) for option in given]

    return make


def set_sequence(name: str) -> Damage:
    """Set the value of ``--seq``; path placeholders are replaced."""

    def make(place: Workspace) -> None:
        place.seq = place.fill_paths(name)

    return make


def rename(name: str) -> Damage:
    """Rename the folder of the sequence."""

    def make(place: Workspace) -> None:
        place.seq = str(place.folder.rename(place.root / name))

    return make


def all_of(*makes: Damage) -> Damage:
    """Combine several changes, applied in this order."""

    def make(place: Workspace) -> None:
        for each in makes:
            each(place)

    return make


def replace_text(old: str, new: str) -> Callable[[bytes], bytes]:
    """Return a change that replaces a text."""
    return lambda content: content.replace(old.encode(), new.encode())


def first_half(content: bytes) -> bytes:
    """First half of a file, as an interrupted copy leaves it."""
    return content[: len(content) // 2]
