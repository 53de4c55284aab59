"""Segmentation of a rolled camera's images in upright orientation.

Networks are trained on upright images and miss people who appear lying in the image of a rolled camera. The up
direction is estimated without a gravity sensor, by the network itself: of the four quarter turns of an image, the
upright one gives the detections with the highest scores. In a search, each turn votes for a direction in the world
frame. As the camera turns, correct votes add up and wrong votes cancel out. A few searches suffice, because the camera
poses relate the up direction to each new frame.

The first image is segmented in all turns. Each later search takes three images, and segments each of them upright and
in one other turn, so that a live camera never waits for four turns of one image. The next three images are such a
search.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from v3d_torch.runtime.input_checks import check_instances
from v3d_torch.segmentation.coco import LABELS
from v3d_torch.segmentation.segmenter import restore_segmenter, segmenter_state_of
from v3d_torch.types import Instances, RGBDFrame, Segmenter

_PRIOR_WEIGHT = 0.5
"""Weight of the prior that the first image is upright, in detections of score 1: most cameras are held upright, but a
single confident detection outweighs the prior."""

_CONFIDENT_WEIGHT = 10.0
"""Length of the sum of votes, in detections of score 1, above which the up direction is settled, because a few wrong
votes can no longer change it."""

_SEARCH_INTERVAL = 8
"""Number of calls between two searches until the up direction is settled: a quarter of a second at 30 Hz, so that
the view of a moving camera has changed. Searches also begin after each power of two of calls, from 4 on."""

_SEARCH_CALLS = 128
"""Number of calls during which searches are this frequent, about 4 s at 30 Hz. It bounds the cost in scenes without
detections, because a search segments three images more."""

_GRAVITY_WEIGHT = 2 * _CONFIDENT_WEIGHT
"""Weight of a measured gravity, in detections of score 1: so large that no search is needed."""


class UprightSegmenter:
    """Segments images of a rolled camera after rotating them upright by quarter turns.

    A measured gravity gives the up direction, and its frame needs no search. Without one, other turns are segmented too
    in some of the first calls, until the up direction is settled, and rarely afterwards.

    Args:
        segment: Segmenter of frames of any size.

    Attributes:
        wrapped: The segmenter of frames of any size.
    """

    def __init__(self, segment: Segmenter) -> None:
        self.wrapped = segment
        self._calls = 0
        self._up = torch.tensor([0.0, -_PRIOR_WEIGHT, 0.0], dtype=torch.float64)

    @property
    def up_votes(self) -> Tensor:
        """Sum of the votes for the up direction, in detections of score 1, world frame, float64, shape :math:`(3,)`.

        A vote replaces the tensor, and never changes it.
        """
        return self._up

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Segment a frame without a pose: upright if its gravity was measured, else in its own orientation."""
        return self.wrapped(frame) if frame.gravity is None else self._segment_rotated(frame, _turns(-frame.gravity))

    def segment_with_pose(self, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
        """Segment a frame in upright orientation.

        Args:
            frame: Frame to segment.
            T_cw: Predicted world-to-camera pose of the frame, float64, shape :math:`(4, 4)`; None if it is not known,
                see `__call__`.

        Returns:
            Instances of the frame in its own orientation.

        Raises:
            ConfigError: If the wrapped segmenter did not return valid `Instances`.
        """
        if T_cw is None:
            return self(frame)
        if frame.gravity is not None:
            self._up = _GRAVITY_WEIGHT * T_cw[:3, :3].T @ -frame.gravity
            self._calls = max(self._calls, _SEARCH_CALLS + 4)  # after the last of the first searches
        turns = self._upright_turns(T_cw)
        others = [(turns + other) % 4 for other in self._other_turns()] if frame.gravity is None else []
        self._calls += 1
        candidates = {each: self._segment_rotated(frame, each) for each in (turns, *others)}
        for each in candidates if others else ():
            # In a search of three calls, the upright turn votes as much in all as each other turn.
            weight = len(others) / 3 if each == turns else 1.0
            # Squared scores, because other orientations give as many detections, but with lower scores.
            votes = weight * float(candidates[each].scores.square().sum())
            self._up = self._up + votes * T_cw[:3, :3].T @ _up_in_camera(each)
        return candidates.get(self._upright_turns(T_cw), candidates[turns])

    def state_dict(self) -> dict[str, Any]:
        """Return the number of calls, the votes for the up direction and the state of the wrapped segmenter."""
        return {"calls": self._calls, "up": self._up.clone(), "wrapped": segmenter_state_of(self.wrapped)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self._calls, self._up = state["calls"], state["up"].clone()
        restore_segmenter(self.wrapped, state.get("wrapped"))

    def _other_turns(self) -> list[int]:
        """Turns to segment beside the upright one, counted from it: all in the first call, later one or none.

        Searches are frequent until the up direction is settled, then rare, because poses are corrected.
        """
        if self._calls == 0:
            return [1, 2, 3]
        offset = self._calls % 4
        start = self._calls - offset  # of the search: a call for the upright image alone, then one for each other turn
        is_settled = start >= _SEARCH_CALLS or float(self._up.norm()) >= _CONFIDENT_WEIGHT
        is_due = start.bit_count() <= 1 or (not is_settled and start % _SEARCH_INTERVAL == 0)
        return [offset] if is_due and offset > 0 else []

    def _upright_turns(self, T_cw: Tensor) -> int:
        """Number of counterclockwise quarter turns that bring an image upright."""
        return _turns(T_cw[:3, :3] @ self._up)

    def _segment_rotated(self, frame: RGBDFrame, turns: int) -> Instances:
        """Segment a frame after counterclockwise quarter turns; the instances are rotated back."""
        if turns != 0:
            image, depth = (torch.rot90(each, turns, dims=(1, 2)).contiguous() for each in (frame.image, frame.depth))
            # Gravity and camera are those of the image before its rotation.
            frame = replace(frame, image=image, depth=depth, gravity=None, camera=None)
        instances = self.wrapped(frame)
        check_instances(instances, frame, LABELS)  # before they are rotated, and before their scores vote
        for _ in range(turns):
            instances = _rotate_clockwise(instances)
        return instances


def _turns(up: Tensor) -> int:
    """Number of counterclockwise quarter turns that bring an image upright, for an up direction (3,), camera frame."""
    x, y, _ = up.tolist()
    return round(math.atan2(x, -y) / (math.pi / 2)) % 4


def _up_in_camera(turns: int) -> Tensor:
    """Up direction, camera frame, if counterclockwise quarter turns bring the image upright, float64, shape (3,)."""
    angle = turns * math.pi / 2
    return torch.tensor([math.sin(angle), -math.cos(angle), 0.0], dtype=torch.float64)


def _rotate_clockwise(instances: Instances) -> Instances:
    """Rotate instances by a quarter turn clockwise."""
    left, top, right, bottom = instances.boxes.unbind(dim=1)
    height = instances.masks.shape[1]
    return Instances(
        masks=torch.rot90(instances.masks, -1, dims=(1, 2)).contiguous(),
        labels=instances.labels,
        scores=instances.scores,
        boxes=torch.stack([height - bottom, left, height - top, right], dim=1),
    )
