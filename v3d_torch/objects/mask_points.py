"""Points of masked pixels: back-projection of the masks of a frame at every n-th pixel."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.config import CloudConfig


def back_project_masks(
    depth: Tensor, masks: Tensor, rays: NDArray[np.float32], config: CloudConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Back-project every n-th masked pixel with depth.

    Args:
        depth: Depth, metres, float32, shape :math:`(H, W)`; 0 = no measurement.
        masks: Masks, bool, shape :math:`(N, H, W)`.
        rays: Ray of every n-th pixel at unit depth, shape :math:`(R, 3)`.
        config: Spacing of the pixels, and maximum depth.

    Returns:
        Points, camera frame, metres, float32, shape :math:`(N, P, 3)`, their validity, bool, :math:`(N, P)`, and their
        row-major pixel indices, int64, :math:`(N, P)`.
    """
    stride = config.stride
    z = depth[::stride, ::stride].numpy()
    selected = masks.numpy()[:, ::stride, ::stride] & ((z > 0) & (z <= config.max_depth))
    count = np.count_nonzero(selected, axis=(1, 2))
    valid = np.arange(max(count.max(initial=0), 1)) < count[:, None]
    pixel = np.flatnonzero(selected) % z.size
    pixels, points = np.zeros(valid.shape, np.int64), np.zeros((*valid.shape, 3), np.float32)
    pixels[valid], points[valid] = pixel, rays[pixel] * z.ravel()[pixel, None]
    return torch.from_numpy(points), torch.from_numpy(valid), torch.from_numpy(pixels)
