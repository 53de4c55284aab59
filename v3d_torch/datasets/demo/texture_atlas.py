"""Texture atlas: the mipmaps of all surfaces in one table, sampled for a whole image at once."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import embedding_bag

_LEVELS = 7
"""Mipmap levels of each texture; a small texture repeats its last level."""
_MIN_TEXTURE_SIZE = 8
"""Textures with a smaller side are not halved again, texels."""
_CHUNK_SIZE = 1 << 15
"""Samples per call of `embedding_bag`: small enough that intermediate results stay in the processor cache."""


class TextureAtlas:
    """Mipmaps (Williams, 1983) of all surfaces, stored as the rows of one table.

    Bilinear sampling is then a weighted sum of four rows, which is torch's ``embedding_bag``.

    Args:
        textures: Textures, RGB in [0, 1], float32, shapes :math:`(H_i, W_i, 3)`.
        densities: Texels per metre of each texture.
    """

    def __init__(self, textures: list[NDArray[np.float32]], densities: list[float]) -> None:
        levels: list[NDArray[np.float32]] = []
        for level in textures:
            for _ in range(_LEVELS):
                levels.append(level)
                height, width = level.shape[:2]
                if min(height, width) >= _MIN_TEXTURE_SIZE:
                    level = np.asarray(cv2.resize(level, (width // 2, height // 2), interpolation=cv2.INTER_AREA))
        self.texels = torch.from_numpy(np.concatenate([level.reshape(-1, 3) for level in levels]))
        sizes = np.asarray([level.shape[:2] for level in levels])
        starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]])
        self.starts, self.heights, self.widths = torch.from_numpy(
            np.stack([starts, *sizes.T]).astype(np.int32)
        ).unbind()
        self.densities = torch.tensor(densities, dtype=torch.float32)

    def __call__(self, surface: Tensor, s: Tensor, t: Tensor, footprint: Tensor) -> Tensor:
        """Sample the textures bilinearly, at the mipmap level whose texels are about as large as the footprint.

        Args:
            surface: Index of the texture, int32, shape :math:`(N,)`.
            s: Horizontal texture coordinate, fraction of the width, shape :math:`(N,)`.
            t: Vertical texture coordinate, fraction of the height, shape :math:`(N,)`.
            footprint: Size of an image sample on the surface, metres, shape :math:`(N,)`.

        Returns:
            RGB in [0, 1], float32, shape :math:`(N, 3)`.
        """
        chunks = zip(*(torch.split(values, _CHUNK_SIZE) for values in (surface, s, t, footprint)), strict=True)
        return torch.cat([self._sample(*chunk) for chunk in chunks])

    def _sample(self, surface: Tensor, s: Tensor, t: Tensor, footprint: Tensor) -> Tensor:
        texels_per_sample = footprint * self.densities.index_select(0, surface)
        level = texels_per_sample.log2_().round_().clamp_(0, _LEVELS - 1).to(torch.int32)
        index = surface * _LEVELS + level
        start, height, width = (table.index_select(0, index) for table in (self.starts, self.heights, self.widths))
        x = torch.minimum((s * width).sub_(0.5).clamp_(min=0.0), width - 1.001)
        y = torch.minimum((t * height).sub_(0.5).clamp_(min=0.0), height - 1.001)
        left, top = x.to(torch.int32), y.to(torch.int32)
        x, y = x - left, y - top
        upper = start + top * width + left
        lower = upper + width
        xy = x * y
        neighbours = torch.stack([upper, upper + 1, lower, lower + 1], dim=1)
        weights = torch.stack([1.0 - x - y + xy, x - xy, y - xy, xy], dim=1)
        return embedding_bag(neighbours, self.texels, mode="sum", per_sample_weights=weights)
