"""Depth re-estimation: a normalised Gaussian that neither invents depth nor bridges its edges (paper, Sec. III-B.1)."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.filters import get_gaussian_kernel2d
from torch import Tensor
from torch.nn.functional import pad

from v3d_torch.errors import ConfigError

_FAR = 1e5
"""Metres: depth beyond counts as missing, so that a placeholder beyond it is far from every measurement."""

_STRIP = 120
"""Rows smoothed at a time, so that what a tap reads and writes stays in the cache: half the time of a whole image."""


def smooth_depth(depth: Tensor, kernel_size: int = 5, sigma: float = 1.0, edge: float = 0.05) -> Tensor:
    r"""Average every measured depth with its measured neighbours on the same surface.

    .. math::
        z'(u, v) = \frac{\sum_{ij} g_{ij}\, G(i, j)\, z(u + i, v + j)}{\sum_{ij} g_{ij}\, G(i, j)}, \qquad
        G(i, j) = e^{-(i^2 + j^2) / 2 \sigma^2}

    where :math:`g_{ij}` is 1 for a neighbour that is measured and whose depth differs from the centre's by at most
    ``edge`` times the centre's, else 0. The paper's equation is the case ``edge=inf`` on an image without holes.

    Args:
        depth: metres, float32 or float64, shape :math:`(B, 1, H, W)`; 0 = no measurement, and so is whatever is
            negative, not a number or beyond 100 km.
        kernel_size: side of the window, pixels, odd.
        sigma: standard deviation of the Gaussian, pixels.
        edge: greatest difference to the centre as a share of the centre's depth; ``math.inf`` switches the gate off.

    Returns:
        Metres, shape and dtype of ``depth``; 0 exactly where there is no measurement. Differentiable in ``depth``, with
        the gate :math:`g` held constant.

    Raises:
        ConfigError: if the window has no centre pixel.
    """
    KORNIA_CHECK_SHAPE(depth, ["B", "1", "H", "W"])
    if kernel_size < 1 or kernel_size % 2 == 0:
        raise ConfigError(f"depth.kernel_size must be odd, as 3 or 5, to have a centre pixel, not {kernel_size}.")
    radius = kernel_size // 2
    sigmas = torch.tensor([[sigma, sigma]], dtype=torch.float64)
    weights = get_gaussian_kernel2d(kernel_size, sigmas)[0].tolist()

    measured = (depth > 0) & (depth < _FAR)
    placeholder = -2 * _FAR
    padded = pad(torch.where(measured, depth, placeholder), (radius,) * 4, value=placeholder)
    reach = (edge * torch.where(measured, depth.detach(), 0)).clamp(max=_FAR)
    strips = [
        _gated_mean(padded[..., top : top + _STRIP + 2 * radius, :], reach[..., top : top + _STRIP, :], weights)
        for top in range(0, depth.shape[-2], _STRIP)
    ]
    return torch.where(measured, torch.cat(strips, dim=-2), 0)


def _gated_mean(padded: Tensor, reach: Tensor, weights: list[list[float]]) -> Tensor:
    """Weighted mean over the window of those neighbours that lie within ``reach`` of the centre.

    The mean of differences to the centre is taken, not of depths: the centre then always has its weight, no quotient is
    0 / 0, and a plane parallel to the image comes out bit for bit.
    """
    height, width = reach.shape[-2:]
    radius = len(weights) // 2
    centre = padded[..., radius : radius + height, radius : radius + width]
    total = torch.zeros_like(centre)
    weight = torch.full_like(reach, weights[radius][radius])
    for row, row_weights in enumerate(weights):
        for column, tap in enumerate(row_weights):
            if row == column == radius:
                continue
            difference = padded[..., row : row + height, column : column + width] - centre
            near = difference.detach().abs().le_(reach)
            weight.add_(near, alpha=tap)
            total.addcmul_(difference, near, value=tap)
    return centre + total / weight


class DepthSmoother(torch.nn.Module):
    """:func:`smooth_depth` as a module.

    Args:
        kernel_size: side of the window, pixels, odd.
        sigma: standard deviation of the Gaussian, pixels.
        edge: greatest difference to the centre as a share of the centre's depth.
    """

    def __init__(self, kernel_size: int = 5, sigma: float = 1.0, edge: float = 0.05) -> None:
        super().__init__()
        self.kernel_size = kernel_size
        self.sigma = sigma
        self.edge = edge

    def forward(self, depth: Tensor) -> Tensor:
        """Smooth depth images, metres, shape :math:`(B, 1, H, W)`; see :func:`smooth_depth`."""
        return smooth_depth(depth, self.kernel_size, self.sigma, self.edge)
