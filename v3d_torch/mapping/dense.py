"""The coloured map of what stands still: keyframes' static pixels, fused by voxels after all corrections."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.camera import BackProjector, PinholeCamera
from v3d_torch.config import DenseMapConfig
from v3d_torch.lie import invert
from v3d_torch.mapping.local_map import Keyframe


class DenseMap:
    """Collects the static pixels of keyframes.

    Args:
        config: resolution and range.
        camera: back-projects the depth.
    """

    def __init__(self, config: DenseMapConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._project = BackProjector(camera)
        self._views: list[tuple[Keyframe, Tensor, Tensor]] = []

    def add(self, keyframe: Keyframe, image: Tensor, depth: Tensor, static: Tensor) -> None:
        """Remember what a keyframe saw.

        Args:
            keyframe: whose pose will place the points.
            image: uint8 RGB, shape :math:`(3, H, W)`.
            depth: metres, shape :math:`(1, H, W)`.
            static: pixels that stand still, bool, shape :math:`(H, W)`.
        """
        step = self._config.stride
        z = depth[0, ::step, ::step]
        keep = static[::step, ::step] & (z > 0) & (z <= self._config.max_depth)
        points = self._project(depth[None])[0, ::step, ::step][keep]
        self._views.append((keyframe, points, image[:, ::step, ::step].permute(1, 2, 0)[keep]))

    def fuse(self) -> tuple[Tensor, Tensor]:
        """All views in the world, one point per voxel: the mean of place and colour.

        Returns:
            Points, metres, float32, :math:`(N, 3)`, and their colours, uint8 RGB, :math:`(N, 3)`.
        """
        sums, counts = torch.zeros(0, 6, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
        for keyframe, seen, colour in self._views:
            T_wk = invert(keyframe.T_cw)
            points = seen.to(torch.float64) @ T_wk[:3, :3].T + T_wk[:3, 3]
            # Taking the views in one by one keeps the memory at the size of the map.
            sums = torch.cat([sums, torch.cat([points, colour.to(torch.float64)], dim=1)])
            counts = torch.cat([counts, torch.ones(len(points), dtype=torch.float64)])
            _, voxel = torch.unique(self._keys(sums[:, :3] / counts[:, None]), return_inverse=True)
            size = int(voxel.max()) + 1 if len(voxel) else 0
            sums = torch.zeros(size, 6, dtype=torch.float64).index_add_(0, voxel, sums)
            counts = torch.zeros(size, dtype=torch.float64).index_add_(0, voxel, counts)
        means = sums / counts[:, None]
        return means[:, :3].to(torch.float32), means[:, 3:].round().to(torch.uint8)

    def _keys(self, points: Tensor) -> Tensor:
        """A number per voxel; 21 bits for each axis reach 10 km to either side at 1 cm."""
        x, y, z = ((points / self._config.voxel_size).floor().to(torch.int64) + (1 << 20)).unbind(dim=1)
        return (x << 42) + (y << 21) + z
