"""Keyframes of the map, and the loops between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.features.features import Features


@dataclass
class Keyframe:
    """A frame that the map keeps.

    Attributes:
        index: number of the keyframe, from 0.
        frame: index of its frame in the sequence; -1 for a keyframe of an earlier run.
        stamp: seconds.
        T_cw: world to camera, float64, shape :math:`(4, 4)`; the back end moves it.
        features: on pixels that stood still.
        landmarks: id of the landmark behind each feature, -1 for none, int64, shape :math:`(N,)`.
        disconnected: whether only a guess joins it to the rest of the map.
        reference: index of the keyframe that it moves along with since it was retired; its own while it is part of the
            map.
    """

    index: int
    frame: int
    stamp: float
    T_cw: Tensor
    features: Features
    landmarks: Tensor
    disconnected: bool = False
    reference: int = -1

    def __post_init__(self) -> None:
        if self.reference < 0:
            self.reference = self.index

    @property
    def is_culled(self) -> bool:
        """Whether the map does without it: it sees nothing any more, but frames and landmarks still hang on it."""
        return self.reference != self.index

    @property
    def is_from_earlier_run(self) -> bool:
        """Whether an earlier run made it."""
        return self.frame < 0

    @property
    def landmark_ids(self) -> Tensor:
        """Ids of the landmarks that it sees, int64, shape :math:`(L,)`."""
        return self.landmarks[self.landmarks >= 0]


def stack_poses(keyframes: Sequence[Keyframe]) -> Tensor:
    """World to camera of keyframes, float64, shape :math:`(K, 4, 4)`; K may be 0."""
    poses = [keyframe.T_cw[None] for keyframe in keyframes]
    return torch.cat([torch.zeros(0, 4, 4, dtype=torch.float64), *poses])


@dataclass(frozen=True)
class Loop:
    """A motion between two keyframes that a place seen again tells.

    Attributes:
        i: index of the older keyframe.
        j: index of the newer one.
        T_ij: pose of camera j in camera i, float64, shape :math:`(4, 4)`.
    """

    i: int
    j: int
    T_ij: Tensor
