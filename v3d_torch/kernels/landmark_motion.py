"""Kernel of the motion of landmarks with their keyframes; see `v3d_torch.mapping.landmark_motion`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Floats, Ints
from v3d_torch.kernels.compiler import kernel
from v3d_torch.kernels.reprojection import transform


@kernel("(f8[:,:,::1], i8[::1], f8[:,::1], f8[:,::1])")
def move_landmarks(T_new_old: Floats, keyframe: Ints, points: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Landmarks and their directions after a motion of the keyframes, both (L, 3).

    Args:
        T_new_old: Motion of each keyframe, (K, 4, 4).
        keyframe: Keyframe with which each landmark moves, (L,).
        points: Landmarks, world frame, metres, (L, 3).
        directions: Directions, world frame, (L, 3).
    """
    moved, turned = np.empty_like(points), np.empty_like(directions)
    for i in range(len(points)):
        T, direction = T_new_old[keyframe[i]], directions[i]
        moved[i, 0], moved[i, 1], moved[i, 2] = transform(T, points[i, 0], points[i, 1], points[i, 2])
        for k in range(3):
            turned[i, k] = T[k, 0] * direction[0] + T[k, 1] * direction[1] + T[k, 2] * direction[2]
    return moved, turned
