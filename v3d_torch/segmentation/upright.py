"""The right way up: networks learn from upright pictures, and overlook people whom a rolled camera shows lying.

A camera without a sense of gravity can still tell up from down by the network itself: of the four turns of an image it
sees most in the one that is upright. Each look at all four is a vote, a direction in the world. True votes add up as
the camera turns, false ones cancel out; a few are enough, as the map carries the direction on from frame to frame.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.types import Instances, RGBDFrame, Segmenter


class UprightSegmenter:
    """Shows a network the images of a rolling camera upright, by quarter turns.

    It looks at all four turns in its first calls, while up is not known, and at next to no cost later.

    Args:
        segment: finds the instances of a frame, of any size.
    """

    _PRIOR = 0.5  # weight, in sure objects, of the first image's own upper edge: most cameras are held upright
    _SURE = 10.0  # votes, in sure objects, that settle which way is up
    _EVERY, _WITHIN = 8, 128  # until then it looks around at every 8th of the first 128 calls: about 4 s

    def __init__(self, segment: Segmenter) -> None:
        self.segment = segment
        self._calls = 0
        self._up = torch.tensor([0.0, -self._PRIOR, 0.0], dtype=torch.float64)  # sum of the votes, in the world

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Instances of a frame, in the image as it is; one whose pose nobody knows is shown as it is."""
        if frame.T_cw is None:
            return self.segment(frame)
        looks = self._looks_around()
        self._calls += 1
        if not looks:
            return self._see(frame, self._turns(frame.T_cw))
        seen = [self._see(frame, turns) for turns in range(4)]
        for turns, instances in enumerate(seen):
            # Squared: what is not upright is seen as well, but as many doubtful things.
            self._up = self._up + float(instances.scores.square().sum()) * frame.T_cw[:3, :3].T @ _edge(turns)
        return seen[self._turns(frame.T_cw)]

    @property
    def memory(self) -> tuple[int, Tensor]:
        """Calls and the sum of their votes, see `Remembering`."""
        return self._calls, self._up

    @memory.setter
    def memory(self, memory: tuple[int, Tensor]) -> None:
        self._calls, self._up = memory

    def _looks_around(self) -> bool:
        """Whether to look at all turns: often at first, then after ever longer times, for the map may be corrected."""
        doubts = self._calls < self._WITHIN and float(self._up.norm()) < self._SURE
        return (doubts and self._calls % self._EVERY == 0) or self._calls.bit_count() <= 1

    def _turns(self, T_cw: Tensor) -> int:
        """Quarter turns, counterclockwise, that set an image upright."""
        x, y, _ = (T_cw[:3, :3] @ self._up).tolist()
        return round(math.atan2(x, -y) / (math.pi / 2)) % 4

    def _see(self, frame: RGBDFrame, turns: int) -> Instances:
        """Instances of a frame that is turned before it is looked at."""
        if turns == 0:
            return self.segment(frame)
        image, depth = (torch.rot90(values, turns, dims=(1, 2)).contiguous() for values in (frame.image, frame.depth))
        instances = self.segment(replace(frame, image=image, depth=depth))
        for _ in range(turns):
            instances = _turned_back(instances)
        return instances


def _edge(turns: int) -> Tensor:
    """Where the edge that so many quarter turns put on top lies in the image as it is, camera frame, shape (3,)."""
    angle = turns * math.pi / 2
    return torch.tensor([math.sin(angle), -math.cos(angle), 0.0], dtype=torch.float64)


def _turned_back(instances: Instances) -> Instances:
    """Instances after a quarter turn clockwise."""
    left, top, right, bottom = instances.boxes.unbind(dim=1)
    height = instances.masks.shape[1]
    return Instances(
        masks=torch.rot90(instances.masks, -1, dims=(1, 2)).contiguous(),
        labels=instances.labels,
        scores=instances.scores,
        boxes=torch.stack([height - bottom, left, height - top, right], dim=1),
    )
