"""Noise-free depth images of a box-shaped room with a box in it: the distance to the surfaces is known exactly."""

from __future__ import annotations

import torch
from torch import Tensor

from helpers.sparse_maps import EYE, no_features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.mapping.keyframe import Keyframe

CAMERA = PinholeCamera(fx=260.0, fy=260.0, cx=159.5, cy=119.5, width=320, height=240, readout=0.0)
ROOM = torch.tensor([[-1.53, -1.11, -1.47], [1.49, 1.17, 1.83]])
"""Lower and upper corner of the room, metres; not on voxel boundaries."""
CRATE = torch.tensor([[-0.33, 0.41, 0.55], [0.37, 1.17, 1.21]])
"""Lower and upper corner of a box on the floor, metres; y points down."""


def keyframe(T_cw: Tensor = EYE, frame: int = 0) -> Keyframe:
    """A keyframe at a pose, without features."""
    return Keyframe(frame, frame, frame / 30, T_cw, no_features(), torch.zeros(0, dtype=torch.int64))


def looking_around(count: int, seed: int = 0) -> Tensor:
    """Poses ``T_wc`` near the centre of the room with one full rotation about the vertical, float64, (count, 4, 4)."""
    generator = torch.Generator().manual_seed(seed)
    twists = 0.15 * (torch.rand(count, 6, generator=generator, dtype=torch.float64) - 0.5)
    turns = torch.zeros(count, 6, dtype=torch.float64)
    turns[:, 4] = 2 * torch.pi * torch.arange(count) / count
    return se3_exp(turns) @ se3_exp(twists)


def render(T_wc: Tensor, *boxes: Tensor, camera: PinholeCamera = CAMERA) -> Tensor:
    """Depth image of the room and of boxes in it, metres, float32, (1, H, W)."""
    origin = T_wc[:3, 3]
    direction = camera.rays.to(torch.float64) @ T_wc[:3, :3].T  # at unit depth
    _, depth = _intersect(ROOM, origin, direction)
    for box in boxes:
        enter, leave = _intersect(box, origin, direction)
        depth = torch.where((enter < leave) & (enter > 0) & (enter < depth), enter, depth)
    return depth[None].to(torch.float32)


def distance_to(points: Tensor, *boxes: Tensor) -> Tensor:
    """Distance of points to the nearest surface of the room and of boxes in it, metres, (N,)."""
    distances = []
    for low, high in (ROOM, *boxes):
        outside = torch.stack([low - points, points - high]).amax(dim=0)  # per axis, negative inside
        beyond = outside.clamp(min=0).norm(dim=1)
        distances.append(torch.where(beyond > 0, beyond, -outside.amax(dim=1)))
    return torch.stack(distances).amin(dim=0)


def _intersect(box: Tensor, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Depths at which rays enter and leave a box, (H, W) each; a ray misses the box if it leaves before it enters."""
    sides = (box.to(torch.float64)[:, None, None] - origin) / direction
    return sides.amin(dim=0).amax(dim=-1), sides.amax(dim=0).amin(dim=-1)
