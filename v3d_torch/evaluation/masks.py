"""How well what moves is left out of tracking, and whether people keep their ids, against true masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

STATIC, UNSURE = 0, 255
"""Values of a true mask that name nobody: what stands still, and what is somebody but only about there."""


@dataclass(frozen=True)
class PersonScore:
    """What became of one person's id.

    Attributes:
        id: in the true masks.
        in_view: frames in which the person is in view.
        found: those of them in which an object covers the person.
        id_changes: how often that object has another id than the last one.
    """

    id: int
    in_view: int
    found: int
    id_changes: int


@dataclass(frozen=True)
class MaskScores:
    """Scores over all frames that have a true mask; None where there is nothing to count.

    Attributes:
        frames: that have a true mask.
        moving_left_out: share of the moving pixels with depth that are left out of tracking.
        static_left_out: share of the static pixels with depth that are; tracking uses no others.
        static_left_out_anywhere: the same over all static pixels, with depth or not.
        id_changes_per_60_frames: changes of all people's ids, for every 60 frames that a person is in view.
        people_found: share of these frames in which an object covers the person: ids that are nowhere do not change.
        people: the counts behind the last two.
    """

    frames: int
    moving_left_out: float | None
    static_left_out: float | None
    static_left_out_anywhere: float | None
    id_changes_per_60_frames: float | None
    people_found: float | None
    people: tuple[PersonScore, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, by attribute."""
        return asdict(self)


class MaskEvaluation:
    """Adds up, frame by frame, what the system left out and which ids it gave to whom.

    A person is in view where enough of the person is seen with depth. The object that covers a person is the one whose
    mask's intersection over union with the true one is largest and above a half, as for the id switches of MOTS
    (Voigtlaender et al., CVPR 2019); where there is none the id neither changes nor is forgotten. Who was out of view
    for longer than `ABSENCE` may come back under another id.
    """

    IN_VIEW = 0.003
    """Least share of the image, 900 pixels at 640x480: a tenth of a person at 5 m. Less is a sleeve behind a door."""
    ABSENCE = 0.5
    """Seconds: about a step. Without appearance nobody can say who comes back after longer."""

    def __init__(self) -> None:
        self._frames = 0
        self._moving, self._static, self._anywhere = torch.zeros(3, 2, dtype=torch.int64)
        self._sightings: dict[int, list[tuple[float, int]]] = {}

    def add(self, stamp: float, truth: Tensor, depth: Tensor, left_out: Tensor, objects: Mapping[int, Tensor]) -> None:
        """Take in a frame; frames come in order of time.

        Args:
            stamp: seconds.
            truth: who moves: 0 what is static, 1-254 a person's id, 255 what belongs to neither, uint8, shape
                :math:`(H, W)`.
            depth: metres, shape :math:`(1, H, W)`; 0 = no measurement.
            left_out: pixels that tracking did not use, bool, shape :math:`(H, W)`.
            objects: mask of each object by its id, which is above 0, bool, shape :math:`(H, W)`; they may overlap.
        """
        measured = depth[0] > 0
        static = truth == STATIC
        self._frames += 1
        self._moving += tally(left_out, ~static & (truth != UNSURE) & measured)
        self._static += tally(left_out, static & measured)
        self._anywhere += tally(left_out, static)
        people = people_in_view(truth, measured, round(self.IN_VIEW * truth.numel()))
        for person, id_ in zip(people.tolist(), covering_ids(truth, people, objects).tolist(), strict=True):
            self._sightings.setdefault(person, []).append((stamp, id_))

    def scores(self) -> MaskScores | None:
        """What has come together; None where no frame had a true mask."""
        if not self._frames:
            return None
        people = tuple(self._score(person) for person in sorted(self._sightings))
        in_view = sum(person.in_view for person in people)
        return MaskScores(
            frames=self._frames,
            moving_left_out=_share(*self._moving.tolist()),
            static_left_out=_share(*self._static.tolist()),
            static_left_out_anywhere=_share(*self._anywhere.tolist()),
            id_changes_per_60_frames=_share(60 * sum(person.id_changes for person in people), in_view),
            people_found=_share(sum(person.found for person in people), in_view),
            people=people,
        )

    def _score(self, person: int) -> PersonScore:
        stamps, ids = zip(*self._sightings[person], strict=True)
        given = torch.tensor(ids)
        changes = count_changes(torch.tensor(stamps, dtype=torch.float64), given, self.ABSENCE)
        return PersonScore(person, in_view=len(ids), found=int((given > 0).sum()), id_changes=changes)


def tally(left_out: Tensor, among: Tensor) -> Tensor:
    """Count pixels.

    Args:
        left_out: bool, shape :math:`(*, H, W)`.
        among: those that count, bool, shape :math:`(*, H, W)`.

    Returns:
        How many of those that count are left out, and how many count, int64, shape :math:`(*, 2)`.
    """
    return torch.stack([(left_out & among).sum(dim=(-2, -1)), among.sum(dim=(-2, -1))], dim=-1)


def people_in_view(truth: Tensor, measured: Tensor, least: int) -> Tensor:
    """Who is seen well enough to be followed.

    Args:
        truth: see `MaskEvaluation.add`, uint8, shape :math:`(H, W)`.
        measured: pixels with depth, bool, shape :math:`(H, W)`.
        least: pixels with depth that a person in view has.

    Returns:
        True ids, int64, increasing, shape :math:`(P,)`.
    """
    visible = _histogram(truth, measured)
    visible[[STATIC, UNSURE]] = 0
    return torch.nonzero(visible >= max(least, 1))[:, 0]


def covering_ids(truth: Tensor, people: Tensor, objects: Mapping[int, Tensor]) -> Tensor:
    """Id of the object that covers each person.

    Args:
        truth: see `MaskEvaluation.add`, uint8, shape :math:`(H, W)`.
        people: true ids, int64, shape :math:`(P,)`.
        objects: see `MaskEvaluation.add`.

    Returns:
        Of the object with the largest intersection over union, 0 where none has more than a half, int64, shape
        :math:`(P,)`.
    """
    true_areas = _histogram(truth, torch.ones_like(truth, dtype=torch.bool))
    # The first row stands for no object: argmax takes the first of equal ones, so that others must be above a half.
    overlaps = [torch.full((len(people),), 0.5)]
    for mask in objects.values():
        both = _histogram(truth, mask)
        overlaps.append((both / (true_areas + both.sum() - both).clamp(min=1))[people])
    return torch.tensor([0, *objects])[torch.stack(overlaps).argmax(dim=0)]


def count_changes(stamps: Tensor, ids: Tensor, absence: float) -> int:
    """How often a person's id changes.

    Args:
        stamps: times at which the person is in view, seconds, increasing, float64, shape :math:`(F,)`.
        ids: given to the person at these times, 0 for none, int64, shape :math:`(F,)`.
        absence: after more time than this out of view a new id is no change, seconds.
    """
    stay, found = (stamps.diff(prepend=stamps[:1]) > absence).cumsum(dim=0), ids > 0
    stay, ids = stay[found], ids[found]
    return int(((ids[1:] != ids[:-1]) & (stay[1:] == stay[:-1])).sum())


def _histogram(truth: Tensor, among: Tensor) -> Tensor:
    """How many pixels of a set have each value of a true mask, int64, shape (256,)."""
    # numpy picks pixels by a mask five times as fast as torch.
    return torch.from_numpy(np.bincount(truth.numpy()[among.numpy()], minlength=UNSURE + 1))


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
