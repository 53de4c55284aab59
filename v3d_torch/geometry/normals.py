"""Surface normals of organised point clouds."""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from v3d_torch.errors import ConfigError
from v3d_torch.geometry.argument_checks import check_counts, check_not_negative, check_shape, is_count
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.kernels import normals as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array

_EPS = 1e-30  # keeps the division by a norm finite
_RADIUS = 4
_EDGE_RATIO = 0.05


def _surface_normals_compiled(points: Tensor, radius: int = _RADIUS, edge_ratio: float = _EDGE_RATIO) -> Tensor:
    if points.dtype != torch.float32 or points.ndim != 4 or points.shape[3] != 3:
        return NotImplemented
    if not is_count(radius) or not edge_ratio >= 0:
        return NotImplemented
    normals = torch.zeros(points.shape, dtype=points.dtype)  # contiguous, even if the points are not
    for image, result in zip(to_array(points), normals.numpy(), strict=True):
        kernels.surface_normals(image, radius, np.float32(edge_ratio), np.float32(_EPS), result)
    return normals


@compiled_by(_surface_normals_compiled)
def surface_normals(points: Tensor, radius: int = _RADIUS, edge_ratio: float = _EDGE_RATIO) -> Tensor:
    """Estimate normals by averaging cross products of neighbour differences over a window.

    Cross products are averaged, not depths: the normal of a plane is exact even if a depth edge cuts the window, where
    averaged depths would bend the plane.

    Args:
        points: Points in the camera frame, metres, one per pixel, shape :math:`(B, H, W, 3)`; z = 0, NaN or infinite
            for pixels without measurement.
        radius: Half the side of the window, pixels; every other row and column of the window is used, from its
            border on.
        edge_ratio: Pixels whose depths differ by more than this fraction lie on different surfaces.

    Returns:
        Unit normals towards the camera, shape and dtype of ``points``, float32 for integers; (0, 0, 0) unless the pixel
        and its four neighbours are measured and lie on one surface.

    Raises:
        ConfigError: If ``radius`` is negative or not a whole number, or ``edge_ratio`` is negative or NaN.
    """
    check_not_negative(edge_ratio=edge_ratio)
    if radius < 0:
        raise ConfigError(f"radius is {radius}; give a number of pixels of at least 0")
    check_counts(radius=radius)
    check_shape("points", points, "B", "H", "W", 3)
    dtype, points = result_dtype(points.dtype), points.to(working_dtype(points.dtype))
    z = points[..., 2]
    # The products below mask these points, too, but their derivatives would make the gradients of neighbours NaN.
    points = torch.where(points.isfinite().all(dim=-1, keepdim=True), points, 0.0)
    right, left, below, above = (_shift(points, *offset) for offset in ((0, 1), (0, -1), (1, 0), (-1, 0)))
    near = [(side[..., 2] > 0) & ((side[..., 2] - z).abs() <= edge_ratio * z) for side in (right, left, below, above)]
    # With x right and y down, this order makes the normals point towards the camera (-z).
    products = torch.linalg.cross(below - above, right - left)
    valid = torch.stack([z > 0, z < torch.inf, *near, products.isfinite().all(dim=-1)]).all(dim=0)[..., None]
    products = torch.where(valid, products, 0.0)
    steps = range(-radius, radius + 1, 2) if radius else (0,)
    total = torch.zeros_like(products)
    for offset in product(steps, steps):
        same_surface = (_shift(z[..., None], *offset) - z[..., None]).abs() <= edge_ratio * z[..., None]
        total += same_surface * _shift(products, *offset)
    return torch.where(valid, total / total.norm(dim=-1, keepdim=True).clamp(min=_EPS), 0.0).to(dtype)


def _shift(images: Tensor, rows: int, columns: int) -> Tensor:
    """Images (B, H, W, C) whose pixel (v, u) is the input's (v + rows, u + columns), 0 beyond the border."""
    height, width = images.shape[1:3]
    margin = max(abs(rows), abs(columns))
    padded = pad(images, (0, 0, margin, margin, margin, margin))
    return padded[:, margin + rows : margin + rows + height, margin + columns : margin + columns + width]
