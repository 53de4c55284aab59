"""Features of a frame: positions, depth, descriptors, and their measurement noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.optim.reprojection import Measurements

_NOT_GIVEN = torch.zeros(0, 2, dtype=torch.float64)

_MIN_DEPTH = 1e-6
"""Keeps 1/z finite for pixels without depth, metres."""


@dataclass(frozen=True)
class Features:
    """ORB features of a frame, with the depth of each.

    Attributes:
        uv: Undistorted pixels, float64, shape :math:`(N, 2)`.
        pixel: Nearest (column, row) in the recorded (distorted) image, int64, shape :math:`(N, 2)`.
        depth: Depth along z, metres, float64, shape :math:`(N,)`; 0 = no measurement.
        octave: Octaves, int64, shape :math:`(N,)`. As for OpenCV's key points, the step between octaves is
            ``features.scale``, not 2. Octave 0 is the image; the pyramid of a large image begins at a higher one.
        descriptors: 256-bit descriptors, uint8, shape :math:`(N, 32)`.
        readout_jacobian: Derivative of ``uv`` with respect to the readout time of a rolling shutter, pixels per second,
            float64, shape :math:`(N, 2)`; 0 if not given, as for a camera at rest.
        sigma_ratio: Standard deviations of the pixel and of the inverse depth, relative to those of the configuration,
            positive, float64, shape :math:`(N, 2)`; 1 if not given. A detector of your own can set it.
    """

    uv: Tensor
    pixel: Tensor
    depth: Tensor
    octave: Tensor
    descriptors: Tensor
    readout_jacobian: Tensor = _NOT_GIVEN
    sigma_ratio: Tensor = _NOT_GIVEN

    def __post_init__(self) -> None:
        if self.readout_jacobian is _NOT_GIVEN:
            object.__setattr__(self, "readout_jacobian", torch.zeros_like(self.uv))
        if self.sigma_ratio is _NOT_GIVEN:
            object.__setattr__(self, "sigma_ratio", torch.ones_like(self.uv))

    def __len__(self) -> int:
        return self.uv.shape[0]

    def __getitem__(self, selected: Tensor | slice) -> Features:
        """Select features by a boolean mask, by indices from 0, or by a slice."""
        if isinstance(selected, slice):
            return Features(**{name: column[selected] for name, column in vars(self).items()})
        indices = torch.nonzero(selected)[:, 0] if selected.dtype == torch.bool else selected
        # index_select is faster than indexing here.
        return Features(**{name: column.index_select(0, indices) for name, column in vars(self).items()})

    @property
    def inverse_depth(self) -> Tensor:
        """Inverse depth, 1/m, float64, shape :math:`(N,)`; 0 = no measurement."""
        return torch.where(self.depth > 0, self.depth.clamp(min=_MIN_DEPTH).reciprocal_(), 0.0)

    def in_mask(self, mask: Tensor) -> Tensor:
        """Check which features lie on the true pixels of a mask.

        Args:
            mask: Mask of the recorded image, bool, shape :math:`(H, W)`.

        Returns:
            Bool, shape :math:`(N,)`.
        """
        return mask[self.pixel[:, 1], self.pixel[:, 0]]


def sample_depth(pixel: Tensor, depth: Tensor, max_depth: float) -> Tensor:
    """Sample a depth image at pixels, without interpolation.

    Args:
        pixel: (column, row), int64, shape :math:`(N, 2)`; pixels outside the image have no depth.
        depth: Depth image, metres, shape :math:`(1, H, W)`; 0 = no measurement.
        max_depth: Depth above this counts as missing, metres.

    Returns:
        Depth, metres, float64, shape :math:`(N,)`; 0 = no measurement.
    """
    column, row = pixel.unbind(dim=1)
    height, width = depth.shape[-2:]
    z = depth[0, row.clamp(0, height - 1), column.clamp(0, width - 1)].to(torch.float64)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return torch.where(inside & (z <= max_depth), z, 0.0)


def select_evenly(pixel: Tensor, count: int, cell: int) -> Tensor:
    """Select pixels evenly over the cells of a grid: first one of each cell, then a second one of each, and so on.

    Args:
        pixel: (column, row), int64, shape :math:`(N, 2)`.
        count: Maximum number of selected pixels.
        cell: Side of a cell, pixels.

    Returns:
        Indices of the selected pixels, int64, ascending, shape (min(N, count),).
    """
    if pixel.shape[0] <= count:
        return torch.arange(pixel.shape[0])
    column, row = (pixel.numpy() // cell).T  # NumPy is faster here
    key, index = row * (int(column.max()) + 1) + column, np.arange(len(row))
    order = np.sort(key * len(key) + index) % len(key)  # an argsort by key; sorting numbers is faster
    rank = np.empty_like(key)  # position of each pixel within its cell
    rank[order] = index - np.searchsorted(key[order], key[order])
    # All pixels of the ranks that fit as a whole, then the first pixels of the next rank.
    full_ranks = np.searchsorted(np.bincount(rank).cumsum(), count, side="right")
    selected, next_rank = rank < full_ranks, np.flatnonzero(rank == full_ranks)
    selected[next_rank[: count - np.count_nonzero(selected)]] = True
    return torch.from_numpy(np.flatnonzero(selected))


def make_measurements(
    uv: Tensor,
    inverse_depth: Tensor,
    octave: Tensor,
    sigma_ratio: Tensor,
    config: TrackingConfig,
    features_config: FeaturesConfig,
) -> Measurements:
    """Measurements and their noise; that of pixels is proportional to the pixel size of their octave.

    Args:
        uv: Undistorted pixels, float64, shape :math:`(N, 2)`.
        inverse_depth: Inverse depth, 1/m, float64, shape :math:`(N,)`; 0 = no measurement.
        octave: Octave of each feature, int64, shape :math:`(N,)`.
        sigma_ratio: See `Features`, float64, shape :math:`(N, 2)`.
        config: Configuration with the standard deviations of pixels at octave 0 and of inverse depth.
        features_config: Scale factor between pyramid levels.
    """
    pixel_ratio, depth_ratio = sigma_ratio.unbind(dim=1)
    return Measurements(
        uv=uv,
        inverse_depth=inverse_depth,
        pixel_sigma=config.pixel_sigma * features_config.scale ** octave.to(torch.float64) * pixel_ratio,
        inverse_depth_sigma=config.inverse_depth_sigma * depth_ratio,
    )


def to_measurements(features: Features, config: TrackingConfig, features_config: FeaturesConfig) -> Measurements:
    """Convert features to measurements with their noise.

    Args:
        features: Features of one frame.
        config: Configuration with the standard deviations of pixels and inverse depth.
        features_config: Scale factor between pyramid levels.
    """
    return make_measurements(
        features.uv, features.inverse_depth, features.octave, features.sigma_ratio, config, features_config
    )
