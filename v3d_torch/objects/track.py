"""One object over time."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from v3d_torch.objects.background import DepthView


@dataclass(frozen=True)
class Sighting:
    """Where an object was at one time.

    Attributes:
        stamp: seconds.
        centroid: world frame, metres, float64, shape :math:`(3,)`; nan when its cloud was too small.
        cloud: world frame, metres, float32, shape :math:`(P, 3)`.
        view: the depth image that it was seen in.
    """

    stamp: float
    centroid: Tensor
    cloud: Tensor
    view: DepthView

    @property
    def located(self) -> bool:
        """Whether the centroid is known."""
        return bool(torch.isfinite(self.centroid).all())


@dataclass(eq=False)  # a track is itself, not its values
class Track:
    """An object with an id, and what was seen of it lately.

    Attributes:
        id: number of the object, from 1, never used again.
        mask: its pixels in the newest frame, bool, shape :math:`(H, W)`; predicted where the network missed it.
        first_seen: seconds.
        sightings: newest last, not older than the history of the configuration.
        velocity: world frame, m/s, float64, shape :math:`(3,)`.
        missed: whether the newest frame has it only by prediction.
        labels: how often the network gave it which class.
        last_dynamic: stamp of the last vote that went through, seconds.
        last_deforming: stamp of the last Chamfer distance above the threshold, seconds.
    """

    id: int
    mask: Tensor
    first_seen: float
    sightings: list[Sighting]
    velocity: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    missed: bool = False
    labels: Counter[int] = field(default_factory=Counter)
    last_dynamic: float = -torch.inf
    last_deforming: float = -torch.inf

    _TOLERANCE: ClassVar[float] = 1e-3  # seconds: stamps are rounded, frame times jitter

    @property
    def label(self) -> int:
        """The class that the network gave most often: it may flicker from frame to frame."""
        return self.labels.most_common(1)[0][0]

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

    def predict(self, stamp: float) -> Tensor:
        """Centroid at ``stamp`` with constant velocity (paper, Sec. II), world frame, shape :math:`(3,)`."""
        return self.located.centroid + self.velocity * (stamp - self.located.stamp)

    def extend(self, sighting: Sighting, gain: float, history: float) -> None:
        """Take in a new sighting: update the velocity, forget what is older than ``history`` seconds."""
        elapsed = sighting.stamp - self.located.stamp
        displacement = sighting.centroid - self.located.centroid
        if elapsed > 0 and torch.isfinite(displacement).all():
            self.velocity = (1 - gain) * self.velocity + gain * displacement / elapsed
        self.sightings.append(sighting)
        while sighting.stamp - self.sightings[0].stamp > history + self._TOLERANCE and len(self.sightings) > 2:
            self.sightings.pop(0)
