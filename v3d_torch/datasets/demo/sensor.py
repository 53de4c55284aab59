"""The Kinect's errors: what a structured-light camera makes of exact depth and colour.

After Khoshelham and Elberink (Accuracy and resolution of Kinect depth data, Sensors 2012), whose disparity model gives
a standard deviation of about 1.4e-3 z^2 metres, and Handa et al. (ICL-NUIM, ICRA 2014), who move pixels sideways at
depth edges.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, pad

from v3d_torch.geometry.camera import PinholeCamera

BASELINE = 0.075
"""From the infrared camera to the projector at its right, metres."""
DISPARITY_STEP = 1.0 / 8.0
"""Resolution of the disparity, pixels."""
DISPARITY_SIGMA = 0.34
"""Noise of the disparity before rounding, in steps; with the rounding it makes 1.4e-3 z^2 metres."""
EDGE = 0.04
"""Least relative jump of the depth between two surfaces."""
EDGE_SIGMA = 0.6
"""Sideways error of the correlation window, pixels."""
FARTHEST = 5.5
"""No depth beyond, metres."""
NEAREST = 0.45
"""No depth before, metres."""
LEAST_INCIDENCE = 0.17
"""Cosine of the angle of incidence below which the pattern is lost."""
COLOUR_SIGMA = 0.008
"""Noise of the colour image, of the full range."""


def sense_depth(depth: Tensor, camera: PinholeCamera, generator: torch.Generator) -> Tensor:
    """Measure exact depth as a Kinect does.

    Args:
        depth: metres, float32, shape :math:`(H, W)`.
        camera: of the depth image.
        generator: of the noise.

    Returns:
        Metres, float32, shape :math:`(H, W)`; 0 = no measurement.
    """
    height, width = depth.shape
    shadow = projector_shadow(depth, camera)
    lost = shadow | grazing(depth, camera) | (depth > FARTHEST) | (depth < NEAREST)

    jitter = EDGE_SIGMA * torch.randn(2, height, width, generator=generator)
    rows = (torch.arange(height)[:, None] + jitter[0]).round().long().clamp(0, height - 1)
    columns = (torch.arange(width)[None, :] + jitter[1]).round().long().clamp(0, width - 1)
    # Only across edges: on a slanted surface a pixel's own depth is what the window's centre sees.
    moved = depth[rows, columns]
    depth = torch.where((moved - depth).abs() > EDGE * depth, moved, depth)

    scale = camera.fx * BASELINE / DISPARITY_STEP
    steps = scale / depth + DISPARITY_SIGMA * _correlated_noise(height, width, generator)
    measured = scale / steps.round().clamp(min=1.0)
    # An edge of the pattern's window sees two surfaces; small specks fail anywhere.
    mixed = edge(depth) & (torch.rand(height, width, generator=generator) < 0.35)
    specks = max_pool2d((torch.rand(1, 1, height, width, generator=generator) < 2e-4).float(), 3, 1, 1)[0, 0] > 0
    return measured.masked_fill(lost | mixed | specks, 0.0)


def sense_colour(colour: Tensor, generator: torch.Generator) -> Tensor:
    """Add the noise of the colour camera.

    Args:
        colour: RGB in [0, 1], shape :math:`(H, W, 3)`.
        generator: of the noise.

    Returns:
        uint8, shape :math:`(H, W, 3)`.
    """
    noisy = colour + COLOUR_SIGMA * torch.randn(colour.shape, generator=generator)
    return (noisy * 255.0).round().clamp(0, 255).to(torch.uint8)


def projector_shadow(depth: Tensor, camera: PinholeCamera) -> Tensor:
    """Pixels that the projector cannot light, because something nearer stands between.

    In the projector's image a point lies at :math:`u - f b / z`; along a row, the points that come after one which
    lies further right are hidden behind it.

    Args:
        depth: metres, shape :math:`(H, W)`.
        camera: of the depth image.

    Returns:
        bool, shape :math:`(H, W)`.
    """
    column = torch.arange(depth.shape[1], dtype=depth.dtype) - camera.fx * BASELINE / depth
    # From the right: the projector stands there, and what is nearer is shifted further left.
    rightmost = column.flip(1).cummin(dim=1).values.flip(1)
    return column > rightmost + 1.5


def grazing(depth: Tensor, camera: PinholeCamera) -> Tensor:
    """Pixels whose surface is seen at so flat an angle that the pattern is lost, shape :math:`(H, W)`.

    The inverse depth of a plane is linear in the pixel, and its gradient gives the plane's normal.
    """
    inverse = 1.0 / depth
    down, right = torch.gradient(inverse)
    x, y = camera.rays[..., 0], camera.rays[..., 1]
    nx, ny = right * camera.fx, down * camera.fy
    nz = inverse - nx * x - ny * y
    cosine = inverse / ((nx**2 + ny**2 + nz**2).sqrt() * (x**2 + y**2 + 1.0).sqrt())
    return (cosine < LEAST_INCIDENCE) & ~edge(depth)


def edge(depth: Tensor) -> Tensor:
    """Pixels beside another surface, shape :math:`(H, W)`: the inverse depth there is not linear in the pixel."""
    inverse = 1.0 / depth
    padded = pad(inverse[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    bend_x = padded[1:-1, 2:] + padded[1:-1, :-2] - 2.0 * inverse
    bend_y = padded[2:, 1:-1] + padded[:-2, 1:-1] - 2.0 * inverse
    return torch.maximum(bend_x.abs(), bend_y.abs()) > EDGE * inverse


def _correlated_noise(height: int, width: int, generator: torch.Generator) -> Tensor:
    """Unit Gaussian noise of neighbours whose correlation windows overlap."""
    kernel = torch.tensor([0.5, 1.0, 0.5])
    kernel = kernel / kernel.norm()
    noise = torch.randn(1, 1, height + 2, width + 2, generator=generator)
    noise = conv2d(conv2d(noise, kernel.reshape(1, 1, 1, 3)), kernel.reshape(1, 1, 3, 1))
    return noise[0, 0]
