"""Interruptions of a sequence: covered camera, dropped frames, camera moved elsewhere and back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from replay import forth_and_back

from v3d_torch.datasets import RGBDSequence
from v3d_torch.segmentation import MaskFolder
from v3d_torch.types import Instances, RGBDFrame

COVERED = NO_POSITION = -1
"""Index of a covered frame; position of a frame that the uninterrupted run does not have."""

AWAY = 30
"""Number of frames that a camera is elsewhere."""


@dataclass(frozen=True)
class Case:
    """An interrupted sequence.

    Attributes:
        name: Name of the interruption.
        shown: Indices of the frames that the camera observes, or `COVERED`.
        times: Times of these frames, in frame intervals of the sequence.
        plain: Positions of the same frames in the run without interruption, or `NO_POSITION`.
        cut: Position in ``shown`` of the first frame of the interruption.
        back: Position in ``shown`` of the first frame after it.
    """

    name: str
    shown: list[int]
    times: list[int]
    plain: list[int]
    cut: int
    back: int


def covered(count: int, before: int, gap: int, after: int) -> Case:
    """Cover the camera for some frames."""
    shown = forth_and_back(count, before + gap + after)
    shown[before : before + gap] = gap * [COVERED]
    positions = list(range(len(shown)))
    return Case(f"{gap} covered", shown, positions, positions, before, before + gap)


def dropped(count: int, before: int, gap: int, after: int) -> Case:
    """Drop frames."""
    shown, positions = forth_and_back(count, before + gap + after), list(range(before + gap + after))
    del shown[before : before + gap], positions[before : before + gap]
    return Case(f"{gap} dropped", shown, positions, positions, before, before)


def elsewhere(count: int, before: int, after: int) -> Case:
    """Move the camera to another part of the sequence and back, each from one frame to the next."""
    path = forth_and_back(count, before + after)
    first = max(count - AWAY, 0)
    shown = [*path[:before], *(first + index for index in forth_and_back(count - first, AWAY)), *path[before:]]
    plain = [*range(before), *(AWAY * [NO_POSITION]), *range(before, before + after)]
    return Case(f"{AWAY} elsewhere", shown, list(range(len(shown))), plain, before, before + AWAY)


def uninterrupted(count: int, frames: int) -> Case:
    """Play the sequence without interruption."""
    positions = list(range(frames))
    return Case("none", forth_and_back(count, frames), positions, positions, frames, frames)


class InterruptedFrames:
    """Frames of a sequence in the order of a case, at the frame rate of the sequence."""

    def __init__(self, sequence: RGBDSequence, case: Case) -> None:
        self._sequence, self._shown = sequence, case.shown
        self.stamps = sequence.stamps[0] + sequence.stamps.diff().median() * torch.tensor(case.times)

    def __iter__(self) -> Iterator[RGBDFrame]:
        for index, shown in enumerate(self._shown):
            frame = self._sequence[max(shown, 0)]
            if shown == COVERED:  # not black, because some light passes through a finger
                frame = replace(frame, image=torch.full_like(frame.image, 3), depth=torch.zeros_like(frame.depth))
            yield replace(frame, index=index, stamp=float(self.stamps[index]))


class InterruptedMasks:
    """Segmenter that returns the stored masks of the frames of a case."""

    def __init__(self, sequence: RGBDSequence, case: Case, folder: Path) -> None:
        self._sequence, self._shown, self._stored = sequence, case.shown, MaskFolder(folder)

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Return the instances of the frame that the camera observes."""
        shown = self._shown[frame.index]
        if shown == COVERED:
            return Instances.empty(*frame.image.shape[-2:])
        return self._stored(replace(frame, index=shown, stamp=float(self._sequence.stamps[shown])))
