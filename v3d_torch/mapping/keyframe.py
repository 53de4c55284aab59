"""Keyframes of the map, and loops between keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.types import LandmarkObserver


@dataclass
class Keyframe(LandmarkObserver):
    """A frame that is stored in the map.

    Attributes:
        index: Index of the keyframe, from 0.
        frame: Index of the frame in the sequence; -1 for a keyframe of an earlier run.
        stamp: Timestamp, seconds.
        T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`; changed by bundle adjustment and loop correction.
        features: Features on static pixels; empty once the keyframe is culled.
        landmarks: Id of the landmark matched to each feature, -1 for none, int64, shape :math:`(N,)`.
        part: Id of the part of the map to which the keyframe belongs. Part 0 is where the map starts. A lost camera
            starts another part, whose pose relative to the other parts is only a guess until a loop joins two parts.
        reference: Index of the reference keyframe. A culled keyframe moves rigidly with its reference keyframe; every
            other keyframe is its own reference.
    """

    index: int
    frame: int
    stamp: float
    T_cw: Tensor
    features: Features
    landmarks: Tensor
    part: int = 0
    reference: int = -1

    def __post_init__(self) -> None:
        if self.reference < 0:
            self.reference = self.index

    @property
    def is_culled(self) -> bool:
        """True if the keyframe was culled: it has no observations, but frames and landmarks still use its pose."""
        return self.reference != self.index

    @property
    def is_disconnected(self) -> bool:
        """True if the pose of the keyframe relative to the start of the map is only a guess."""
        return self.part != 0

    @property
    def is_from_earlier_run(self) -> bool:
        """True if the keyframe was created by an earlier run."""
        return self.frame < 0


def stack_poses(keyframes: Sequence[Keyframe]) -> Tensor:
    """Return the world-to-camera poses of keyframes, float64, shape :math:`(K, 4, 4)`; K can be 0."""
    poses = [keyframe.T_cw for keyframe in keyframes]
    return torch.stack(poses) if poses else torch.zeros(0, 4, 4, dtype=torch.float64)


@dataclass(frozen=True)
class Loop:
    """Relative pose of two keyframes, measured by place recognition.

    Attributes:
        i: Index of the older keyframe.
        j: Index of the newer keyframe.
        T_ij: Pose of camera j in camera i, float64, shape :math:`(4, 4)`.
    """

    i: int
    j: int
    T_ij: Tensor
