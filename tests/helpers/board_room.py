"""Views of boards that hang in front of a wall, with depth that can be shifted and delayed against colour."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from helpers.sparse_maps import no_features, uniform
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(260.0, 260.0, 159.5, 119.5, width=320, height=240, depth_scale=5000.0)
RATE = 30.0
BOARDS = 10


_CENTRE = (uniform(BOARDS, 2, seed=1) - 0.5) * torch.tensor([2.8, 2.0])
_HALF = 0.12 + 0.2 * uniform(BOARDS, 2, seed=2)
_DISTANCE = 1.3 + 1.0 * uniform(BOARDS, seed=3)
_COLOUR = 40 + 180 * uniform(BOARDS + 1, 3, seed=4)
_WAVES = 25 * (uniform(BOARDS + 1, 2, seed=5) - 0.5)
_WALL = 3.5


def pose_at(time: float) -> Tensor:
    """World-to-camera pose of a hand-held camera, float64, (4, 4)."""
    phase = torch.arange(6, dtype=torch.float64)
    amplitude = torch.tensor([0.10, 0.06, 0.08, 0.08, 0.12, 0.06], dtype=torch.float64)
    return se3_exp(amplitude * torch.sin((3 + 0.7 * phase) * time + phase))


@cache
def render_at(time: float) -> tuple[Tensor, Tensor]:
    """Exact colour, uint8 (3, H, W), and depth, metres (1, H, W), of the hand-held camera at a time."""
    T_wc = invert(pose_at(time))
    rays = CAMERA.rays.double() @ T_wc[:3, :3].T  # (H, W, 3)
    planes = torch.cat([_DISTANCE, torch.tensor([_WALL])])
    depth = (planes - T_wc[2, 3]) / rays[..., 2:]  # (H, W, boards + wall)
    xy = T_wc[:2, 3] + depth[..., None] * rays[..., None, :2]
    inside = ((xy[..., :-1, :] - _CENTRE).abs() <= _HALF).all(dim=-1)
    inside = torch.cat([inside, torch.ones_like(inside[..., :1])], dim=-1)
    z, board = torch.where(inside, depth, torch.inf).min(dim=-1)
    on_board = xy.gather(2, board[..., None, None].expand(*board.shape, 1, 2))[..., 0, :]
    pattern = 1 + 0.1 * torch.sin((on_board * _WAVES[board]).sum(dim=-1))
    colour = (_COLOUR[board] * pattern[..., None]).clamp(0, 255).to(torch.uint8).permute(2, 0, 1)
    return colour, z[None].float()


def make_views(
    count: int = 6,
    *,
    shift: tuple[int, int] = (0, 0),
    delay: float = 0.0,
    stated_delay: float = 0.0,
    scale: float = 1.0,
    moving: bool = True,
    zoom: int = 1,
) -> tuple[StaticViews, Trajectory]:
    """Make the views of a camera that moves in front of the boards, and its trajectory.

    Args:
        count: Number of views, a third of a second apart.
        shift: Shift of the depth images along u and v, pixels.
        delay: Time of the depth image minus time of the colour image, seconds.
        stated_delay: The same by the timestamps.
        scale: Factor of the depth.
        moving: False for a camera that stands still.
        zoom: Number of columns and of rows of the frames for each rendered one; with 2 or more, it is also the stride
            of the views.
    """
    speed = RATE if moving else torch.inf
    stamps = torch.arange(10 * count + 10, dtype=torch.float64)
    T_cw = torch.stack([pose_at(float(stamp) / speed) for stamp in stamps])
    fx, fy, cx, cy = (zoom * value for value in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy))
    camera = PinholeCamera(fx, fy, cx, cy, width=zoom * CAMERA.width, height=zoom * CAMERA.height, depth_scale=5000.0)
    views = StaticViews(camera, max(zoom, 2))
    for index in range(count):
        frame = 5 + 10 * index
        time = frame / speed
        colour, depth = (
            image.repeat_interleave(zoom, 1).repeat_interleave(zoom, 2)
            for image in (render_at(time)[0], render_at(time + delay * RATE / speed)[1])
        )
        depth = depth.roll(shift, (2, 1)) * scale
        keyframe = Keyframe(index, frame, frame / RATE, T_cw[frame], no_features(), torch.zeros(0).long())
        views.add(keyframe, colour, depth, torch.ones(depth.shape[1:], dtype=torch.bool), stated_delay)
    return views, Trajectory(stamps / RATE, invert(T_cw))
