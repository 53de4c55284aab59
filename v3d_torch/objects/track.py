"""One object over time."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig
from v3d_torch.objects.kalman_filter import ConstantVelocityKalmanFilter
from v3d_torch.segmentation.coco import UNLABELLED


@dataclass(frozen=True, eq=False)  # a sighting is itself, not its values
class Detection3D:
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
    def is_located(self) -> bool:
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
    cloud_pixels: Tensor
    coarse_mask: Tensor
    first_seen: float
    config: TrackerConfig
    detections: list[Detection3D] = field(default_factory=list)
    missed: bool = False
    labels: Counter[int] = field(default_factory=Counter)
    label: int = UNLABELLED
    score: float = 0.0
    dynamic_frames: int = 0
    last_dynamic: float = -torch.inf
    last_deforming: float = -torch.inf

    _TOLERANCE: ClassVar[float] = 1e-3  # seconds: stamps are rounded, frame times jitter

    def __post_init__(self) -> None:
        self._motion = ConstantVelocityKalmanFilter(self.config)
        self._most_points = 1

    def update_label(self, label: int, score: float) -> None:
        """Take in the class that the network gives it in a frame, and with which score."""
        self.labels[label] += 1
        self.score += score
        named = Counter({label: count for label, count in self.labels.items() if label != UNLABELLED})
        self.label = (named or self.labels).most_common(1)[0][0]

    @property
    def newest(self) -> Detection3D:
        """The last time that the network saw the object."""
        return self.detections[-1]

    @property
    def last_located(self) -> Detection3D:
        """The last sighting with a centroid; the newest one when none has."""
        return next((sighting for sighting in reversed(self.detections) if sighting.is_located), self.newest)

    def detection_pair(self, baseline: float) -> tuple[Detection3D, Detection3D] | None:
        """The newest sighting and the newest one at least ``baseline`` seconds before it; 0 means the one before.

        Returns:
            (then, now), both with a centroid; None when there is no such pair.
        """
        now = self.newest
        for then in reversed(self.detections[:-1]):
            if now.stamp - then.stamp >= baseline - self._TOLERANCE:
                return (then, now) if then.is_located and now.is_located else None
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

    def add_detection(self, sighting: Detection3D) -> None:
        """Take in a new sighting, and forget what is older than the history."""
        self._most_points = max(self._most_points, len(sighting.cloud))
        hidden = 1 - len(sighting.cloud) / self._most_points  # the centroid of a part is not that of the whole
        sigma = self.config.centroid_sigma + self.config.partial_sigma * hidden
        self._motion.update(sighting.stamp, sighting.centroid, sigma)
        self.detections.append(sighting)
        oldest = sighting.stamp - self.config.history - self._TOLERANCE
        while self.detections[0].stamp < oldest and len(self.detections) > 2:
            self.detections.pop(0)

    def move_world(self, T_new_old: Tensor) -> None:
        """Carry all of it along when the map is corrected under it, see `InstanceTracker.move_world`."""
        R, t = T_new_old[:3, :3], T_new_old[:3, 3]
        self._motion.move_world(T_new_old)
        self.detections = [
            Detection3D(s.stamp, R @ s.centroid + t, s.cloud @ R.T.to(s.cloud) + t.to(s.cloud)) for s in self.detections
        ]
