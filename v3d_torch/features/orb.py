"""ORB features on the pixels that stand still, spread over the image (paper, Sec. III-A; Rublee et al., ICCV 2011)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import kornia_rs
import torch
from torch import Tensor

from v3d_torch.config import FeaturesConfig, TrackingConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.optim.reprojection import Measurements

_NOT_GIVEN = torch.zeros(0, 2, dtype=torch.float64)


@dataclass(frozen=True)
class Features:
    """ORB features of one frame, with the depth under each.

    Attributes:
        uv: undistorted pixels, float64, shape :math:`(N, 2)`.
        pixel: (column, row) in the image as delivered, int64, shape :math:`(N, 2)`.
        depth: metres, float64, shape :math:`(N,)`; 0 = no measurement.
        octave: level of the scale pyramid, int64, shape :math:`(N,)`.
        descriptors: 256 bits each, uint8, shape :math:`(N, 32)`.
        readout_jacobian: how ``uv`` changes with the time that the camera takes to read an image, pixels per second, float64,
            shape :math:`(N, 2)`; 0 for a camera that stands still, and where it is not given.
    """

    uv: Tensor
    pixel: Tensor
    depth: Tensor
    octave: Tensor
    descriptors: Tensor
    readout_jacobian: Tensor = _NOT_GIVEN

    def __post_init__(self) -> None:
        if self.readout_jacobian is _NOT_GIVEN:
            object.__setattr__(self, "readout_jacobian", torch.zeros_like(self.uv))

    def __len__(self) -> int:
        return self.uv.shape[0]

    def __getitem__(self, keep: Tensor) -> Features:
        """Features chosen by a boolean mask or by indices."""
        return Features(**{field.name: getattr(self, field.name)[keep] for field in fields(self)})

    @property
    def inverse_depth(self) -> Tensor:
        """1/m, float64, shape :math:`(N,)`; 0 where there is no depth."""
        return torch.where(self.depth > 0, 1.0 / self.depth.clamp(min=1e-6), 0.0)

    def in_mask(self, mask: Tensor) -> Tensor:
        """Which features lie on the true pixels of ``mask``, a bool :math:`(H, W)`; bool, shape :math:`(N,)`."""
        return mask[self.pixel[:, 1], self.pixel[:, 0]]


class ORB:
    """Detects and describes ORB features with kornia-rs.

    Args:
        config: how many, on how many levels.
        camera: undistorts the features.
    """

    def __init__(self, config: FeaturesConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera

    def __call__(self, image: Tensor, depth: Tensor) -> Features:
        """Detect features on the whole image; masks come later.

        Args:
            image: uint8 RGB, shape :math:`(3, H, W)`.
            depth: metres, shape :math:`(1, H, W)`, 0 = none.
        """
        found = kornia_rs.features.orb_detect_and_compute(
            image.permute(1, 2, 0).contiguous().numpy(),
            n_keypoints=self._config.count,
            n_scales=self._config.levels,
            downscale=self._config.scale,
        )
        height, width = image.shape[-2:]
        place = torch.from_numpy(found.keypoints_xy.copy()).to(torch.float64).reshape(-1, 2)
        pixel = place.round().to(torch.int64)
        pixel = torch.stack([pixel[:, 0].clamp(0, width - 1), pixel[:, 1].clamp(0, height - 1)], dim=1)
        return Features(
            uv=self._camera.undistort(place),
            pixel=pixel,
            depth=sample_depth(pixel, depth, self._config.max_depth),
            octave=torch.from_numpy(found.octaves.astype("int64")),
            descriptors=torch.from_numpy(found.descriptors.copy()).reshape(-1, 32),
        )


def sample_depth(pixel: Tensor, depth: Tensor, max_depth: float) -> Tensor:
    """Depth at pixels.

    Args:
        pixel: (column, row), int64, shape :math:`(N, 2)`; outside the image there is no depth.
        depth: metres, shape :math:`(1, H, W)`, 0 = none.
        max_depth: depth beyond is taken for none, metres.

    Returns:
        Metres, float64, shape :math:`(N,)`, 0 = none.
    """
    column, row = pixel.unbind(dim=1)
    height, width = depth.shape[-2:]
    z = depth[0, row.clamp(0, height - 1), column.clamp(0, width - 1)].to(torch.float64)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return torch.where(inside & (z <= max_depth), z, 0.0)


def select_evenly(pixel: Tensor, count: int, cell: int) -> Tensor:
    """Choose at most ``count`` places, evenly from the cells of a grid: the k-th of any cell before a (k+1)-th.

    Args:
        pixel: (column, row), int64, shape :math:`(N, 2)`.
        count: most places chosen.
        cell: side of a cell, pixels.

    Returns:
        Indices, int64, ascending, shape :math:`(<= count,)`.
    """
    if pixel.shape[0] <= count:
        return torch.arange(pixel.shape[0])
    columns = int(pixel[:, 0].max()) // cell + 1
    key = (pixel[:, 1] // cell) * columns + pixel[:, 0] // cell
    order = torch.argsort(key, stable=True)
    rank = torch.empty_like(key)
    rank[order] = torch.arange(key.shape[0]) - torch.searchsorted(key[order], key[order], side="left")
    return torch.argsort(rank, stable=True)[:count].sort().values


def pixel_sigma(octave: Tensor, config: TrackingConfig, pyramid: FeaturesConfig) -> Tensor:
    """Standard deviation of a feature's place, pixels: it is as sure as its level of the scale pyramid is fine."""
    return config.pixel_sigma * pyramid.scale ** octave.to(torch.float64)


def measurements(features: Features, config: TrackingConfig, pyramid: FeaturesConfig) -> Measurements:
    """Features as measurements."""
    return Measurements(
        uv=features.uv,
        inverse_depth=features.inverse_depth,
        pixel_sigma=pixel_sigma(features.octave, config, pyramid),
        inverse_depth_sigma=config.inverse_depth_sigma,
    )
