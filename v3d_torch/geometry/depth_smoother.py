"""Depth re-estimation: an edge-preserving Gaussian filter that ignores missing depth (paper, Sec. III-B.1)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from v3d_torch.errors import ConfigError
from v3d_torch.geometry.argument_checks import check_not_negative, check_positive, check_shape, is_count
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import depth_smoother as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array

_MAX_VALID_DEPTH = 1e5
"""Depth above this counts as missing, metres. The placeholder of missing pixels differs from any depth by more."""

_STRIP_HEIGHT = 120
"""Rows filtered at a time. The intermediate results of a strip stay in the processor's cache."""


def _smooth_depth_compiled(depth: Tensor, kernel_size: int = 5, sigma: float = 1.0, edge_ratio: float = 0.05) -> Tensor:
    is_image = depth.dtype == torch.float32 and depth.ndim == 4 and depth.shape[1] == 1
    if not is_image or not _has_centre(kernel_size) or not sigma > 0 or not edge_ratio >= 0:
        return NotImplemented
    taps = np.array(_gaussian(kernel_size, sigma), np.float32)
    limits = np.float32(edge_ratio), np.float32(_MAX_VALID_DEPTH)
    smoothed = torch.empty(depth.shape, dtype=depth.dtype)
    for image, result in zip(depth[:, 0], smoothed[:, 0], strict=True):
        kernels.smooth_depth(to_array(image), taps, *limits, result.numpy())
    return smoothed


@compiled_by(_smooth_depth_compiled)
def smooth_depth(depth: Tensor, kernel_size: int = 5, sigma: float = 1.0, edge_ratio: float = 0.05) -> Tensor:
    r"""Smooth a depth image without filling holes and without blurring across depth edges.

    .. math::
        z'(u, v) = \frac{\sum_j g_j\, G(j) \sum_i g_{ij}\, G(i)\, z(u + i, v + j)}
                        {\sum_j g_j\, G(j) \sum_i g_{ij}\, G(i)}, \qquad
        G(i) = e^{-i^2 / 2 \sigma^2}

    The gates keep the average on one surface: :math:`g_j` is 1 if the pixel j rows away is measured and its depth
    differs from the centre's by at most ``edge_ratio`` times the centre's depth, else 0; :math:`g_{ij}` compares the
    pixel (i, j) with the pixel (0, j) in the same way. The filter is separable: sums along rows come first, then sums
    along columns. The paper's equation is the case ``edge_ratio=inf`` on an image without holes.

    Args:
        depth: Depth, metres, shape :math:`(B, 1, H, W)`; 0 = no measurement. Negative values, NaN
            and depth beyond 100 km count as missing, too. Half precision is converted to float32.
        kernel_size: Side of the window, pixels, odd.
        sigma: Standard deviation of the Gaussian, pixels.
        edge_ratio: Largest accepted difference from the centre's depth, as a fraction of the centre's depth;
            ``math.inf`` disables the gates.

    Returns:
        Smoothed depth, metres, shape and dtype of ``depth``, float32 for integers; exactly 0 for pixels without
        measurement. Differentiable in ``depth``, with the gates :math:`g` held constant.

    Raises:
        ConfigError: If the window has no centre pixel, ``sigma`` is not positive, or ``edge_ratio`` is negative or NaN.
    """
    _check_settings(kernel_size, sigma, edge_ratio)
    check_shape("depth", depth, "B", 1, "H", "W")
    radius = kernel_size // 2
    taps, height = _gaussian(kernel_size, sigma), depth.shape[-2]
    wide = depth.to(working_dtype(depth.dtype))  # half precision cannot represent the placeholder
    strips = []
    for top in range(0, max(height, 1), _STRIP_HEIGHT):  # one empty strip of an image without rows
        margin = min(radius, top)
        rows = slice(top - margin, min(top + _STRIP_HEIGHT + radius, height))
        strips.append(_smooth(wide[..., rows, :], taps, edge_ratio)[..., margin : margin + _STRIP_HEIGHT, :])
    return torch.cat(strips, dim=-2).to(result_dtype(depth.dtype))


def _check_settings(kernel_size: int, sigma: float, edge_ratio: float) -> None:
    check_positive(sigma=sigma)
    check_not_negative(edge_ratio=edge_ratio)
    if not _has_centre(kernel_size):
        raise ConfigError(f"kernel_size is {kernel_size}; give an odd number of pixels, such as 3 or 5")


def _has_centre(kernel_size: int) -> bool:
    return is_count(kernel_size) and kernel_size % 2 == 1


def _gaussian(kernel_size: int, sigma: float) -> tuple[float, ...]:
    """Return the weights of a Gaussian from the centre outwards; their sum over the whole window is 1."""
    taps = [math.exp(-(distance**2) / (2 * sigma**2)) for distance in range(kernel_size // 2 + 1)]
    total = math.fsum([*taps, *taps[1:]])
    return tuple(tap / total for tap in taps)


def _smooth(depth: Tensor, taps: tuple[float, ...], edge_ratio: float) -> Tensor:
    """Smooth an image with a Gaussian, given by its weights from the centre outwards.

    The filter averages differences to the centre's depth, not depths. The centre always has a weight, so that no
    quotient is 0 / 0, and the depth of a plane parallel to the image does not change by a bit.
    """
    measured = (depth > 0) & (depth < _MAX_VALID_DEPTH)
    z = torch.where(measured, depth, -2 * _MAX_VALID_DEPTH)
    max_difference = (edge_ratio * z.detach()).clamp(0, _MAX_VALID_DEPTH)
    total, weight = torch.zeros_like(z), torch.ones_like(z)
    for dim in (-1, -2):
        total, weight = _convolve(total, weight, z, max_difference, taps, dim)
    return torch.where(measured, z + total / weight, 0)


def _convolve(
    total: Tensor, weight: Tensor, z: Tensor, max_difference: Tensor, taps: tuple[float, ...], dim: int
) -> tuple[Tensor, Tensor]:
    """Accumulate weighted depth differences along one dimension.

    Args:
        total: Weighted sum of depth differences to each pixel.
        weight: Sum of the weights in ``total``.
        z: Depth, metres.
        max_difference: Largest accepted difference between a pixel's depth and a neighbour's, metres.
        taps: Weights of the neighbours by their distance in pixels, from 0.
        dim: Dimension along which to accumulate.

    Returns:
        Sums of weighted differences to each pixel's depth, over the pixel and its neighbours, and sums of the weights.
    """
    sums, weights = total * taps[0], weight * taps[0]
    for distance, tap in enumerate(taps[1:], start=1):
        pairs = max(z.shape[dim] - distance, 0)
        step = z.narrow(dim, -pairs, pairs) - z.narrow(dim, 0, pairs)
        size = step.detach().abs()
        # Each pair of pixels counts in both directions.
        for centre, neighbour, sign in ((0, -pairs, 1), (-pairs, 0, -1)):
            same_surface = (size <= max_difference.narrow(dim, centre, pairs)).to(size.dtype)
            neighbour_weight = weight.narrow(dim, neighbour, pairs)
            difference = torch.addcmul(total.narrow(dim, neighbour, pairs), neighbour_weight, step, value=sign)
            sums.narrow(dim, centre, pairs).addcmul_(difference, same_surface, value=tap)
            weights.narrow(dim, centre, pairs).addcmul_(neighbour_weight, same_surface, value=tap)
    return sums, weights


class DepthSmoother(SettingsModule):
    """Depth re-estimation as a module; see :func:`smooth_depth`.

    Args:
        kernel_size: Side of the window, pixels, odd.
        sigma: Standard deviation of the Gaussian, pixels.
        edge_ratio: Largest accepted difference from the centre's depth, as a fraction of the centre's depth.

    Raises:
        ConfigError: If a number is not possible; see :func:`smooth_depth`.
    """

    def __init__(self, kernel_size: int = 5, sigma: float = 1.0, edge_ratio: float = 0.05) -> None:
        _check_settings(kernel_size, sigma, edge_ratio)
        super().__init__()
        self.kernel_size = kernel_size
        self.sigma = sigma
        self.edge_ratio = edge_ratio

    def forward(self, depth: Tensor) -> Tensor:
        """Smooth depth images, metres, shape :math:`(B, 1, H, W)`; see :func:`smooth_depth`."""
        return smooth_depth(depth, self.kernel_size, self.sigma, self.edge_ratio)
