"""Kernel of surface normals; see `v3d_torch.geometry.normals`."""

from __future__ import annotations

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats32
from v3d_torch.kernels.compiler import device, kernel


@device
def _multiply_differences(points: Floats32, edge_ratio: np.float32, products: Floats32, valid: Bools) -> None:
    """Write the cross product of the differences of each pixel's neighbours, if all lie on one surface.

    Args:
        points: Points, camera frame, (H, W, 3); z = 0 or not finite without measurement.
        edge_ratio: Largest difference between depths on one surface, as a fraction of the depth.
        products: Cross products, zeros, (3, H, W); written if they are finite.
        valid: True where a product is written, zeros, (H, W).
    """
    height, width, _ = points.shape
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            z = points[v, u, 2]
            limit = edge_ratio * z
            right, left, below, above = points[v, u + 1], points[v, u - 1], points[v + 1, u], points[v - 1, u]
            nearest = min(min(right[2], left[2]), min(below[2], above[2]))
            farthest = max(max(right[2], left[2]), max(below[2], above[2]))
            if not (0 < z < np.inf and nearest > 0 and z - nearest <= limit and farthest - z <= limit):
                continue
            x0, y0, z0 = below[0] - above[0], below[1] - above[1], below[2] - above[2]
            x1, y1, z1 = right[0] - left[0], right[1] - left[1], right[2] - left[2]
            x, y, w = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
            if np.isfinite(x) and np.isfinite(y) and np.isfinite(w):  # minimum and maximum can ignore NaN
                products[0, v, u], products[1, v, u], products[2, v, u], valid[v, u] = x, y, w, True


@device
def _add_neighbours(z: Floats32, limit: Floats32, z_neighbour: Floats32, product: Floats32, total: Floats32) -> None:
    """Add one coordinate of the neighbours' products to a row, where the neighbour lies on the same surface.

    The compiler vectorises this loop; all arrays have shape (W,).
    """
    for u in range(len(total)):
        total[u] += product[u] if abs(z_neighbour[u] - z[u]) <= limit[u] else np.float32(0)


@kernel("(f4[:,:,::1], i8, f4, f4, f4[:,:,::1])")
def surface_normals(points: Floats32, radius: int, edge_ratio: np.float32, eps: np.float32, normals: Floats32) -> None:
    """Average the cross products of neighbour differences over a window around each pixel, and normalise.

    Args:
        points: Points, camera frame, (H, W, 3); z = 0 without measurement.
        radius: Half the side of the window, pixels; every other row and column is used.
        edge_ratio: Largest difference between depths on one surface, as a fraction of the depth.
        eps: Smallest divisor.
        normals: Unit normals, (H, W, 3), zeros; written where the pixel and its four neighbours lie on one surface.
    """
    height, width, _ = points.shape
    inner_rows, inside = slice(radius, radius + height), slice(radius, radius + width)
    products = np.zeros((3, height + 2 * radius, width + 2 * radius), np.float32)
    depth, valid = np.zeros(products.shape[1:], np.float32), np.zeros((height, width), np.bool_)
    depth[inner_rows, inside] = points[..., 2]
    _multiply_differences(points, edge_ratio, products[:, inner_rows, inside], valid)
    total = np.empty((3, width), np.float32)
    for v in range(height):
        z = depth[v + radius, inside]
        limit = edge_ratio * z
        total[:] = 0
        for row in range(v, v + 2 * radius + 1, 2):
            for column in range(0, 2 * radius + 1, 2):
                window = slice(column, column + width)
                for axis in range(3):
                    _add_neighbours(z, limit, depth[row, window], products[axis, row, window], total[axis])
        for u in range(width):
            if valid[v, u]:
                x, y, w = total[0, u], total[1, u], total[2, u]
                length = max(np.sqrt(x * x + y * y + w * w), eps)
                normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = x / length, y / length, w / length
