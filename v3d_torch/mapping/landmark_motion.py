"""Motion of landmarks with the keyframes that created them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from v3d_torch.kernels import landmark_motion as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array


def _move_landmarks_compiled(
    T_new_old: Tensor, keyframe: Tensor, points: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    if any(each.dtype != torch.float64 for each in (T_new_old, points, directions)):
        return NotImplemented
    moved = kernels.move_landmarks(*map(to_array, (T_new_old, keyframe, points, directions)))
    return torch.from_numpy(moved[0]), torch.from_numpy(moved[1])


@compiled_by(_move_landmarks_compiled)
def move_landmarks(T_new_old: Tensor, keyframe: Tensor, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Move each landmark rigidly with a keyframe.

    Args:
        T_new_old: Motion of each keyframe: it maps the old to the new positions of its landmarks, world frame, float64,
            shape :math:`(K, 4, 4)`.
        keyframe: Index of the keyframe that created each landmark, int64, shape :math:`(L,)`.
        points: Positions of the landmarks, world frame, metres, float64, shape :math:`(L, 3)`.
        directions: Viewing directions of the landmarks, world frame, float64, shape :math:`(L, 3)`.

    Returns:
        Moved positions and directions, both float64, shape :math:`(L, 3)`.
    """
    # Multiply element by element for all landmarks at once; faster than a small matrix product for each landmark.
    owner = keyframe.numpy()
    motions = T_new_old[:, :3].flatten(1).T.numpy()
    elements = np.stack([element.take(owner) for element in motions]).reshape(3, 4, -1)
    x, y, z = points.numpy().T.copy()
    moved = elements[:, 0] * x + elements[:, 1] * y + elements[:, 2] * z + elements[:, 3]
    x, y, z = directions.numpy().T.copy()
    turned = elements[:, 0] * x + elements[:, 1] * y + elements[:, 2] * z
    return torch.from_numpy(moved.T), torch.from_numpy(turned.T)
