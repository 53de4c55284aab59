"""One object over time."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from v3d_torch.config import IdentityConfig
from v3d_torch.objects.motion_filter import MotionFilter
from v3d_torch.segmentation.coco import UNNAMED


@dataclass(frozen=True, eq=False)  # a sighting is itself, not its values
class Sighting:
    """Where an object was at one time.

    Attributes:
        stamp: seconds.
        centroid: world frame, metres, float64, shape :math:`(3,)`; nan when its cloud was too small.
        cloud: world frame, metres, float32, shape :math:`(P, 3)`.
    """

    stamp: float
    centroid: Tensor
    cloud: Tensor

    @cached_property
    def located(self) -> bool:
        """Whether the centroid is known."""
        return bool(torch.isfinite(self.centroid).all())


@dataclass(eq=False)  # a track is itself, not its values
class Track:
    """An object with an id, and what was seen of it lately.

    Attributes:
        id: number of the object, from 1, never used again.
        mask: its pixels in the newest frame, bool, shape :math:`(H, W)`; predicted where the network missed it.
        own: those of them whose depth is its own, bool, shape :math:`(H, W)`.
        coarse: every n-th pixel of the mask, as the tracker compares them, float32, shape :math:`(P,)`.
        first_seen: seconds.
        config: noise of centroids, and for how long they are remembered.
        sightings: newest last, not older than the history of the configuration; at least one.
        missed: whether the newest frame has it only by prediction.
        labels: how often the network gave it which class.
        label: the class that it gave most often: it may flicker from frame to frame. A name once given stays.
        score: sum of the scores that the network gave it.
        evidence: frames in which it was voted dynamic.
        last_dynamic: stamp of the last vote that went through, seconds.
        last_deforming: stamp of the last Chamfer distance above the threshold, seconds.
    """

    id: int
    mask: Tensor
    own: Tensor
    coarse: Tensor
    first_seen: float
    config: IdentityConfig
    sightings: list[Sighting] = field(default_factory=list)
    missed: bool = False
    labels: Counter[int] = field(default_factory=Counter)
    label: int = UNNAMED
    score: float = 0.0
    evidence: int = 0
    last_dynamic: float = -torch.inf
    last_deforming: float = -torch.inf

    _TOLERANCE: ClassVar[float] = 1e-3  # seconds: stamps are rounded, frame times jitter

    def __post_init__(self) -> None:
        self._motion = MotionFilter(self.config)
        self._most_points = 1

    def name(self, label: int, score: float) -> None:
        """Take in the class that the network gives it in a frame, and with which score."""
        self.labels[label] += 1
        self.score += score
        named = Counter({label: count for label, count in self.labels.items() if label != UNNAMED})
        self.label = (named or self.labels).most_common(1)[0][0]

    @property
    def newest(self) -> Sighting:
        """The last time that the network saw the object."""
        return self.sightings[-1]

    @property
    def located(self) -> Sighting:
        """The last sighting with a centroid; the newest one when none has."""
        return next((sighting for sighting in reversed(self.sightings) if sighting.located), self.newest)

    def pair(self, baseline: float) -> tuple[Sighting, Sighting] | None:
        """The newest sighting and the newest one at least ``baseline`` seconds before it; 0 means the one before.

        Returns:
            (then, now), both with a centroid; None when there is no such pair.
        """
        now = self.newest
        for then in reversed(self.sightings[:-1]):
            if now.stamp - then.stamp >= baseline - self._TOLERANCE:
                return (then, now) if then.located and now.located else None
        return None

    @property
    def velocity(self) -> Tensor:
        """World frame, m/s, float64, shape :math:`(3,)`; 0 while the sightings are too few to tell."""
        return self._motion.velocity

    def predict(self, stamp: float) -> Tensor:
        """Centroid at ``stamp`` with constant velocity (paper, Sec. II), world frame, shape :math:`(3,)`."""
        return self._motion.predict(stamp)

    def cloud_at(self, stamp: float) -> Tensor:
        """The newest cloud, moved on with constant velocity, world frame, float64, shape :math:`(P, 3)`."""
        return self.newest.cloud.to(torch.float64) + self.velocity * (stamp - self.newest.stamp)

    def extend(self, sighting: Sighting) -> None:
        """Take in a new sighting, and forget what is older than the history."""
        self._most_points = max(self._most_points, len(sighting.cloud))
        hidden = 1 - len(sighting.cloud) / self._most_points  # the centroid of a part is not that of the whole
        sigma = self.config.centroid_sigma + self.config.partial_sigma * hidden
        self._motion.update(sighting.stamp, sighting.centroid, sigma)
        self.sightings.append(sighting)
        oldest = sighting.stamp - self.config.history - self._TOLERANCE
        while self.sightings[0].stamp < oldest and len(self.sightings) > 2:
            self.sightings.pop(0)

    def move_world(self, T_new_old: Tensor) -> None:
        """Carry all of it along when the map is corrected under it, see `InstanceTracker.move_world`."""
        R, t = T_new_old[:3, :3], T_new_old[:3, 3]
        self._motion.move_world(T_new_old)
        self.sightings = [
            Sighting(s.stamp, R @ s.centroid + t, s.cloud @ R.T.to(s.cloud) + t.to(s.cloud)) for s in self.sightings
        ]
