"""Evaluation of the masks and object ids of a run against ground-truth masks of moving people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

STATIC = 0
"""Value of static pixels in a ground-truth mask."""

UNSURE = 255
"""Value of pixels in a ground-truth mask that are neither certainly moving nor certainly static."""

_MIN_OVERLAP = 0.5
"""Intersection over union above which an object covers a person, as for the id switches of MOTS."""

MIN_FRACTION_IN_VIEW = 0.003
"""Minimum fraction of the image that a person in view covers: 900 pixels at 640x480, about a tenth of a person at
5 m. No detector finds smaller parts, such as a sleeve behind a door."""

MAX_ABSENCE = 0.5
"""Maximum time out of view after which the id must be the same, seconds. The score measures whether ids continue, not
whether people are recognised: after a longer absence, the last position of a person does not show who returns."""


@dataclass(frozen=True)
class PersonScore:
    """Counts of one person.

    Attributes:
        id: Id of the person in the ground-truth masks.
        in_view: Number of frames in which the person is in view.
        found: Number of these frames in which an object covers the person.
        id_switches: Number of times that the object that covers the person has a different id than the last such
            object.
    """

    id: int
    in_view: int
    found: int
    id_switches: int


@dataclass(frozen=True)
class MaskScores:
    """Scores over all frames with a ground-truth mask; a ratio is None if its denominator is zero.

    Attributes:
        frames: Number of frames with a ground-truth mask.
        moving_masked: Fraction of the moving pixels with depth that are masked.
        static_masked: Fraction of the static pixels with depth that are masked. Tracking uses only pixels with depth.
        static_masked_anywhere: Fraction of all static pixels, with or without depth, that are masked.
        id_switches_per_60_frames: Id switches of all people per 60 frames in view.
        people_found: Fraction of the frames in view in which an object covers the person. It is needed to interpret the
            id switches: a person who is never found has no id switches.
        people: Counts of each person.
    """

    frames: int
    moving_masked: float | None
    static_masked: float | None
    static_masked_anywhere: float | None
    id_switches_per_60_frames: float | None
    people_found: float | None
    people: tuple[PersonScore, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, by attribute."""
        return asdict(self)


class MaskEvaluation:
    """Accumulator of mask and id scores over the frames of a run.

    A person is in view if enough of their pixels have depth. A person is covered by the object whose mask has the
    largest intersection over union with the ground truth, if it is above one half, as for the id switches of MOTS
    (Voigtlaender et al., CVPR 2019). In frames in which no object covers the person, the last id is kept. A person who
    was out of view for longer than `MAX_ABSENCE` can return with another id; this is not an id switch.
    """

    def __init__(self) -> None:
        self._frames = 0
        self._moving, self._static, self._anywhere = torch.zeros(3, 2, dtype=torch.int64)
        self._ids_in_view: dict[int, list[tuple[float, int]]] = {}  # person: (stamp, id of the covering object)

    def add(self, stamp: float, truth: Tensor, depth: Tensor, masked: Tensor, objects: Mapping[int, Tensor]) -> None:
        """Add a frame. Frames are added in the order of their timestamps.

        Args:
            stamp: Timestamp, seconds.
            truth: Ground-truth mask: 0 for static pixels, 1-254 for the id of a person or thing that moves, 255 for
                neither, uint8, shape :math:`(H, W)`.
            depth: Depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.
            masked: Masked pixels, bool, shape :math:`(H, W)`.
            objects: Mask of each object by its id (> 0), bool, shape :math:`(H, W)`; masks can overlap.
        """
        measured = depth[0] > 0
        static = truth == STATIC
        self._frames += 1
        self._moving += tally(masked, ~static & (truth != UNSURE) & measured)
        self._static += tally(masked, static & measured)
        self._anywhere += tally(masked, static)
        people = people_in_view(truth, measured, round(MIN_FRACTION_IN_VIEW * truth.numel()))
        for person, id_ in zip(people.tolist(), covering_ids(truth, people, objects).tolist(), strict=True):
            self._ids_in_view.setdefault(person, []).append((stamp, id_))

    def compute_scores(self) -> MaskScores | None:
        """Compute the scores of the added frames; None if no frame was added."""
        if not self._frames:
            return None
        people = tuple(self._score(person) for person in sorted(self._ids_in_view))
        in_view = sum(person.in_view for person in people)
        return MaskScores(
            frames=self._frames,
            moving_masked=_ratio(*self._moving.tolist()),
            static_masked=_ratio(*self._static.tolist()),
            static_masked_anywhere=_ratio(*self._anywhere.tolist()),
            id_switches_per_60_frames=_ratio(60 * sum(person.id_switches for person in people), in_view),
            people_found=_ratio(sum(person.found for person in people), in_view),
            people=people,
        )

    def _score(self, person: int) -> PersonScore:
        stamps, ids = zip(*self._ids_in_view[person], strict=True)
        object_ids = torch.tensor(ids)
        switches = count_id_switches(torch.tensor(stamps, dtype=torch.float64), object_ids, MAX_ABSENCE)
        return PersonScore(person, in_view=len(ids), found=int((object_ids > 0).sum()), id_switches=switches)


def tally(masked: Tensor, region: Tensor) -> Tensor:
    """Count the pixels of a region, and those of them that are masked.

    Args:
        masked: Masked pixels, bool, shape :math:`(*, H, W)`.
        region: Pixels to count, bool, shape :math:`(*, H, W)`.

    Returns:
        Number of masked pixels of the region, and number of pixels of the region, int64, shape :math:`(*, 2)`.
    """
    return torch.stack([(masked & region).sum(dim=(-2, -1)), region.sum(dim=(-2, -1))], dim=-1)


def people_in_view(truth: Tensor, measured: Tensor, min_pixels: int) -> Tensor:
    """Return the ids of the people with enough visible pixels to be tracked.

    Args:
        truth: Ground-truth mask, see `MaskEvaluation.add`, uint8, shape :math:`(H, W)`.
        measured: Pixels with depth, bool, shape :math:`(H, W)`.
        min_pixels: Minimum number of pixels with depth of a person in view.

    Returns:
        Ground-truth ids, int64, increasing, shape :math:`(P,)`.
    """
    visible = _count_values(truth, measured)
    visible[[STATIC, UNSURE]] = 0
    return torch.nonzero(visible >= max(min_pixels, 1))[:, 0]


def covering_ids(truth: Tensor, people: Tensor, objects: Mapping[int, Tensor]) -> Tensor:
    """Return the id of the object that covers each person.

    Args:
        truth: Ground-truth mask, see `MaskEvaluation.add`, uint8, shape :math:`(H, W)`.
        people: Ground-truth ids, int64, shape :math:`(P,)`.
        objects: Mask of each object, see `MaskEvaluation.add`.

    Returns:
        Id of the object with the largest intersection over union, 0 if none is above one half, int64, shape
        :math:`(P,)`.
    """
    true_areas = _count_values(truth, torch.ones_like(truth, dtype=torch.bool))
    # The first row represents no object. Of equal values argmax returns the first, so an object must exceed it.
    overlaps = [torch.full((len(people),), _MIN_OVERLAP)]
    for mask in objects.values():
        intersection = _count_values(truth, mask)
        union = true_areas + intersection[:UNSURE].sum() - intersection  # as in the other scores
        overlaps.append((intersection / union.clamp(min=1))[people])
    return torch.tensor([0, *objects])[torch.stack(overlaps).argmax(dim=0)]


def count_id_switches(stamps: Tensor, ids: Tensor, max_absence: float) -> int:
    """Count the id switches of a person.

    Args:
        stamps: Timestamps of the frames in which the person is in view, seconds, increasing, float64, shape
            :math:`(F,)`.
        ids: Id of the object that covers the person in these frames, 0 for none, int64, shape :math:`(F,)`.
        max_absence: Maximum time out of view, seconds; a new id after a longer time is not a switch.
    """
    visit, found = (stamps.diff(prepend=stamps[:1]) > max_absence).cumsum(dim=0), ids > 0
    visit, ids = visit[found], ids[found]
    return int(((ids[1:] != ids[:-1]) & (visit[1:] == visit[:-1])).sum())


def _count_values(truth: Tensor, region: Tensor) -> Tensor:
    """Count the pixels of a region by their value in a ground-truth mask, int64, shape (256,)."""
    # NumPy is faster at boolean indexing than torch.
    return torch.from_numpy(np.bincount(truth.numpy()[region.numpy()], minlength=UNSURE + 1))


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None
