"""Depth re-estimation: a normalised Gaussian that neither invents depth nor bridges its edges (paper, Sec. III-B.1)."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from kornia.filters import get_gaussian_kernel1d
from torch import Tensor

from v3d_torch.errors import ConfigError

_FAR = 1e5
"""Metres: depth beyond counts as missing, so that a placeholder beyond it is far from every measurement."""

_STRIP = 120
"""Rows smoothed at a time, so that what a tap reads and writes stays in the cache: half the time of a whole image."""


def smooth_depth(depth: Tensor, kernel_size: int = 5, sigma: float = 1.0, edge: float = 0.05) -> Tensor:
    r"""Average every measured depth with its measured neighbours on the same surface.

    .. math::
        z'(u, v) = \frac{\sum_j g_j\, G(j) \sum_i g_{ij}\, G(i)\, z(u + i, v + j)}
                        {\sum_j g_j\, G(j) \sum_i g_{ij}\, G(i)}, \qquad
        G(i) = e^{-i^2 / 2 \sigma^2}

    where :math:`g_j` is 1 for a pixel j rows on that is measured and whose depth differs from the centre's by at most
    ``edge`` times the centre's, else 0, and :math:`g_{ij}` says the same of the pixel i columns beside that one. So
    rows are added up first, then columns, in half the time of all neighbours one by one. The paper's equation is the
    case ``edge=inf`` on an image without holes.

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
    gaussian = get_gaussian_kernel1d(kernel_size, torch.tensor([[sigma]], dtype=torch.float64))[0]
    taps, height = gaussian[radius:].tolist(), depth.shape[-2]
    strips = []
    for top in range(0, height, _STRIP):
        above = min(radius, top)
        rows = slice(top - above, min(top + _STRIP + radius, height))
        strips.append(_smooth(depth[..., rows, :], taps, edge)[..., above : above + _STRIP, :])
    return torch.cat(strips, dim=-2)


def _smooth(depth: Tensor, taps: list[float], edge: float) -> Tensor:
    """Smooth an image with one half of the Gaussian, from its middle on.

    Differences to the centre are averaged, not depths: the centre then always has its weight, no quotient is 0 / 0, and
    a plane parallel to the image comes out bit for bit.
    """
    measured = (depth > 0) & (depth < _FAR)
    z = torch.where(measured, depth, -2 * _FAR)
    reach = (edge * z.detach()).clamp(0, _FAR)
    total, weight = torch.zeros_like(z), torch.ones_like(z)
    for dim in (-1, -2):
        total, weight = _add_up(total, weight, z, reach, taps, dim)
    return torch.where(measured, z + total / weight, 0)


def _add_up(
    total: Tensor, weight: Tensor, z: Tensor, reach: Tensor, taps: list[float], dim: int
) -> tuple[Tensor, Tensor]:
    """Sums over neighbours along one dimension.

    Args:
        total: at each pixel, weighted sum of differences to its depth.
        weight: sum of those weights.
        z: depth.
        reach: greatest difference to the depth of a pixel that its neighbours may have.
        taps: weights of neighbours by their distance, from 0 on.
        dim: in which they lie.

    Returns:
        Sum and weights over all that the pixel and its neighbours have, now of differences to the pixel's depth.
    """
    sums, weights = total * taps[0], weight * taps[0]
    for distance, tap in enumerate(taps[1:], start=1):
        pairs = max(z.shape[dim] - distance, 0)
        step = z.narrow(dim, -pairs, pairs) - z.narrow(dim, 0, pairs)
        size = step.detach().abs()
        for here, there, sign in ((0, -pairs, 1), (-pairs, 0, -1)):  # each pair counts for both of its pixels
            near = torch.le(size, reach.narrow(dim, here, pairs), out=torch.empty_like(size))
            other = weight.narrow(dim, there, pairs)
            difference = torch.addcmul(total.narrow(dim, there, pairs), other, step, value=sign)
            sums.narrow(dim, here, pairs).addcmul_(difference, near, value=tap)
            weights.narrow(dim, here, pairs).addcmul_(other, near, value=tap)
    return sums, weights


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
