"""Noise model of a structured-light camera (Kinect), applied to exact depth and colour.

Depth noise follows Khoshelham and Elberink (Accuracy and resolution of Kinect depth data, Sensors 2012), whose
disparity model gives a standard deviation of about 1.4e-3 z^2 metres. Pixels near depth edges are displaced sideways
as in Handa et al. (ICL-NUIM, ICRA 2014).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, pad

from v3d_torch.geometry.camera import PinholeCamera

_BASELINE = 0.075
"""Distance from the infrared camera to the projector on its right, metres."""
_DISPARITY_STEP = 1.0 / 8.0
"""Resolution of the disparity, pixels."""
_DISPARITY_SIGMA = 0.34
"""Noise of the disparity before rounding, in steps; together with the rounding it gives 1.4e-3 z^2 metres."""
_EDGE_RATIO = 0.04
"""Smallest relative change of depth that counts as an edge between two surfaces."""
_EDGE_SIGMA = 0.6
"""Sideways error at depth edges, pixels: the correlation window covers both surfaces."""
_MIN_DEPTH, MAX_DEPTH = 0.45, 5.5
"""Range of the sensor, metres."""
_MIN_INCIDENCE_COSINE = 0.17
"""Smallest cosine of the angle of incidence at which the pattern is still recognised."""
_SHADOW_MARGIN = 1.5
"""Distance that a point must be behind the shadow boundary to be in shadow, pixels."""
_MIXED_RATE = 0.35
"""Fraction of edge pixels without measurement, because the correlation window covers two surfaces."""
_SPECK_RATE = 2e-4
"""Fraction of pixels at which a speck of 3x3 pixels has no measurement."""
_COLOUR_SIGMA = 0.008
"""Noise of the colour image, as a fraction of its full range."""


def simulate_depth(depth: Tensor, camera: PinholeCamera, generator: torch.Generator) -> Tensor:
    """Simulate the depth image of a Kinect.

    Args:
        depth: Exact depth, metres, float32, shape :math:`(H, W)`.
        camera: Camera of the depth image.
        generator: Random generator of the noise.

    Returns:
        Measured depth, metres, float32, shape :math:`(H, W)`; 0 = no measurement.
    """
    height, width = depth.shape
    shadow = projector_shadow(depth, camera)
    invalid = shadow | grazing_incidence(depth, camera) | (depth > MAX_DEPTH) | (depth < _MIN_DEPTH)

    jitter = _EDGE_SIGMA * torch.randn(2, height, width, generator=generator)
    rows = (torch.arange(height)[:, None] + jitter[0]).round().long().clamp(0, height - 1)
    columns = (torch.arange(width)[None, :] + jitter[1]).round().long().clamp(0, width - 1)
    # Displace pixels across edges only: on a slanted surface the window measures the depth at its centre.
    displaced = depth[rows, columns]
    depth = torch.where((displaced - depth).abs() > _EDGE_RATIO * depth, displaced, depth)

    scale = camera.fx * _BASELINE / _DISPARITY_STEP
    steps = scale / depth + _DISPARITY_SIGMA * _correlated_noise(height, width, generator)
    measured = scale / steps.round().clamp(min=1.0)
    mixed = depth_edges(depth) & (torch.rand(height, width, generator=generator) < _MIXED_RATE)
    speck_centres = (torch.rand(1, 1, height, width, generator=generator) < _SPECK_RATE).float()
    specks = max_pool2d(speck_centres, 3, 1, 1)[0, 0] > 0
    return measured.masked_fill(invalid | mixed | specks, 0.0)


def simulate_colour(colour: Tensor, generator: torch.Generator) -> Tensor:
    """Simulate the colour image of a Kinect: add noise and quantise.

    Args:
        colour: Exact colour, RGB in [0, 1], shape :math:`(H, W, 3)`.
        generator: Random generator of the noise.

    Returns:
        Measured colour, RGB, uint8, shape :math:`(H, W, 3)`.
    """
    noisy = colour + _COLOUR_SIGMA * torch.randn(colour.shape, generator=generator)
    return (noisy * 255.0).round().clamp(0, 255).to(torch.uint8)


def projector_shadow(depth: Tensor, camera: PinholeCamera) -> Tensor:
    """Mask of pixels that the projector cannot light because a nearer surface occludes them.

    In the image of the projector a point is at column :math:`u - f b / z`. A point is occluded if a point to its right
    in the camera image is at a smaller projector column.

    Args:
        depth: Depth, metres, shape :math:`(H, W)`.
        camera: Camera of the depth image.

    Returns:
        Shadow mask, bool, shape :math:`(H, W)`.
    """
    column = torch.arange(depth.shape[1], dtype=depth.dtype) - camera.fx * _BASELINE / depth
    min_column_to_right = column.flip(1).cummin(dim=1).values.flip(1)
    return column > min_column_to_right + _SHADOW_MARGIN


def grazing_incidence(depth: Tensor, camera: PinholeCamera) -> Tensor:
    """Mask of pixels at which the surface is too slanted for the pattern to be recognised.

    The inverse depth of a plane is linear in the pixel, and its gradient gives the normal of the plane.

    Args:
        depth: Depth, metres, shape :math:`(H, W)`.
        camera: Camera of the depth image.

    Returns:
        Mask, bool, shape :math:`(H, W)`.
    """
    inverse = 1.0 / depth
    down, right = torch.gradient(inverse)
    x, y = camera.rays[..., 0], camera.rays[..., 1]
    nx, ny = right * camera.fx, down * camera.fy
    nz = inverse - nx * x - ny * y
    cosine = inverse / ((nx**2 + ny**2 + nz**2).sqrt() * (x**2 + y**2 + 1.0).sqrt())
    return (cosine < _MIN_INCIDENCE_COSINE) & ~depth_edges(depth)


def depth_edges(depth: Tensor) -> Tensor:
    """Mask of pixels next to another surface, at which the inverse depth is not linear in the pixel.

    Args:
        depth: Depth, metres, shape :math:`(H, W)`.

    Returns:
        Mask, bool, shape :math:`(H, W)`.
    """
    inverse = 1.0 / depth
    padded = pad(inverse[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    second_x = padded[1:-1, 2:] + padded[1:-1, :-2] - 2.0 * inverse
    second_y = padded[2:, 1:-1] + padded[:-2, 1:-1] - 2.0 * inverse
    return torch.maximum(second_x.abs(), second_y.abs()) > _EDGE_RATIO * inverse


def _correlated_noise(height: int, width: int, generator: torch.Generator) -> Tensor:
    """Generate unit Gaussian noise that is correlated between neighbours, whose correlation windows overlap."""
    kernel = torch.tensor([0.5, 1.0, 0.5])
    kernel = kernel / kernel.norm()
    noise = torch.randn(1, 1, height + 2, width + 2, generator=generator)
    noise = conv2d(conv2d(noise, kernel.reshape(1, 1, 1, 3)), kernel.reshape(1, 1, 3, 1))
    return noise[0, 0]
