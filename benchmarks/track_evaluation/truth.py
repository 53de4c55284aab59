"""True people of a sequence, frame by frame, from its masks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.base import HasMotionMasks
from v3d_torch.datasets.demo.renderer import Renderer
from v3d_torch.datasets.demo.scenes import SCENES
from v3d_torch.datasets.demo.sequence import CAMERA, FRAME_RATE, SEED
from v3d_torch.errors import InputError
from v3d_torch.evaluation.masks import MIN_FRACTION_IN_VIEW, STATIC, UNSURE

IGNORED = 255
"""Value of the pixels in `TruePeople.owner` that are not evaluated."""

MIN_SECONDS_IN_VIEW = 0.5
"""Minimum time in view of evaluated people in the whole sequence, seconds. Most people with less time are shoes that
have their own id in the masks."""

_SECOND_PERSON = 1000
"""The second person of a split id gets the id plus this number."""

CORRECTIONS: dict[str, dict[str, Any]] = yaml.safe_load(
    Path(__file__).with_name("true_ids.yaml").read_text(encoding="utf-8")
)


@dataclass(frozen=True)
class TruePeople:
    """True people in one frame.

    Attributes:
        stamp: Timestamp, seconds.
        owner: Number of the person at each pixel, 1 for the first of ``ids``; 0 for static pixels, `IGNORED` for pixels
            that are not evaluated; uint8, shape (H, W).
        ids: Ids of the people in view, increasing.
    """

    stamp: float
    owner: NDArray[np.uint8]
    ids: tuple[int, ...]


def true_people(sequence: RGBDSequence, frames: int | None = None, *, correct_ids: bool = True) -> list[TruePeople]:
    """Return the true people of all frames.

    A person is in view if enough of their pixels have depth, as in `MaskEvaluation`. Pixels of people who are not in
    view, or too short a time, and uncertain pixels are not evaluated.

    Args:
        sequence: Sequence with true masks.
        frames: Number of first frames to use; None for all.
        correct_ids: True to correct the ids of people that the masks confuse.

    Raises:
        InputError: If a frame has no true mask.
    """
    corrections = CORRECTIONS.get(sequence.name, {}) if correct_ids else {}
    masks, ids_of_values, in_view = [], [], []
    count = len(sequence) if frames is None else frames
    for index, mask in enumerate(
        _rendered_masks(sequence.name, count) if sequence.name in SCENES else _stored_masks(sequence, count)
    ):
        id_of_value = corrected_ids(index, corrections)
        measured = np.bincount(mask[sequence[index].depth[0].numpy() > 0], minlength=UNSURE + 1)
        pixels: Counter[int] = Counter()
        for value in np.flatnonzero(measured):
            pixels[id_of_value[value]] += int(measured[value])
        masks.append(mask)
        ids_of_values.append(id_of_value)
        enough = MIN_FRACTION_IN_VIEW * mask.size
        in_view.append({id_ for id_, count in pixels.items() if id_ not in (STATIC, UNSURE) and count >= enough})
    rate = (len(sequence) - 1) / float(sequence.stamps[-1] - sequence.stamps[0])
    frames_of = Counter(id_ for people in in_view for id_ in people)
    evaluated = {id_ for id_, count in frames_of.items() if count >= MIN_SECONDS_IN_VIEW * rate}
    return [
        _number_people(stamp, mask, id_of_value, tuple(sorted(people & evaluated)))
        for stamp, mask, id_of_value, people in zip(
            sequence.stamps[: len(masks)].tolist(), masks, ids_of_values, in_view, strict=True
        )
    ]


def _stored_masks(sequence: RGBDSequence, count: int) -> Iterator[NDArray[np.uint8]]:
    for index in range(count):
        mask = sequence.motion_mask(index) if isinstance(sequence, HasMotionMasks) else None
        if mask is None:
            raise InputError(f"{sequence.name}: frame {index} has no true mask; choose another sequence")
        yield mask.numpy()


def _rendered_masks(name: str, count: int) -> Iterator[NDArray[np.uint8]]:
    """Render masks of the people of a built-in sequence, those who are still as well."""
    scene = SCENES[name](SEED)
    renderer = Renderer(scene, CAMERA)
    people = [instance for instance, label in scene.labels.items() if label == "person"]
    for index in range(count):
        time = index / FRAME_RATE
        mask = renderer(scene.trajectory.pose(time), time).instance_mask.numpy()
        yield np.where(np.isin(mask, people), mask, 0).astype(np.uint8)


def corrected_ids(index: int, corrections: dict[str, Any]) -> list[int]:
    """Return the id of the person behind each value of a mask.

    Args:
        index: Index of the frame.
        corrections: Corrections of the sequence, see ``true_ids.yaml``.
    """
    person = list(range(UNSURE + 1))
    for value in corrections.get("ignore", []):
        person[value] = UNSURE
    for value, first_frame in corrections.get("split", {}).items():
        if index >= first_frame:
            person[value] += _SECOND_PERSON
    for first, *others in corrections.get("merge", []):
        for value in others:
            person[value] = first
    return person


def _number_people(stamp: float, mask: NDArray[np.uint8], id_of_value: list[int], ids: tuple[int, ...]) -> TruePeople:
    """Replace the values of a mask by the numbers of the people; all other people are not evaluated."""
    numbers = {STATIC: 0} | {id_: number for number, id_ in enumerate(ids, start=1)}
    number_of_value = np.array([numbers.get(id_, IGNORED) for id_ in id_of_value], np.uint8)
    return TruePeople(stamp, number_of_value[mask], ids)
