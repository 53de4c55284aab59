"""The camera's way through the room, for viewers of meshes: a line through all frames, a frustum at each keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib as mpl
import torch
from matplotlib.colors import to_rgb
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import Trajectory

STATUS_COLOURS = {"odometry": "#ff7f0e", "disconnected": "#d62728", "lost": "#d62728", "earlier": "#7f7f7f"}
"""Colour of what is not tracked, or of an earlier run; what is tracked turns from dark blue to yellow with time."""

_LENGTH = 0.08  # metres from the camera's centre to its image plane: in a room, seen from above, neither dot nor house
_SIDES = torch.tensor([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 5]])  # the last one says where up is
_LINES = torch.tensor([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [1, 5], [5, 2]])


@dataclass(frozen=True)
class CameraPath:
    """Coloured vertices with triangles and lines between them.

    Attributes:
        points: world frame, metres, float64, shape :math:`(N, 3)`.
        colours: RGB, uint8, shape :math:`(N, 3)`.
        faces: sides of the frustums, int64, shape :math:`(F, 3)`.
        edges: of the frustums, and of the way from frame to frame, int64, shape :math:`(E, 2)`.
    """

    points: Tensor
    colours: Tensor
    faces: Tensor
    edges: Tensor


def camera_path(
    trajectory: Trajectory, statuses: list[str], T_wk: Tensor, frames: list[int], camera: PinholeCamera
) -> CameraPath:
    """Draw a trajectory.

    Args:
        trajectory: of all frames.
        statuses: how each frame was found: "tracked", or a key of `STATUS_COLOURS`.
        T_wk: camera to world of the keyframes, float64, shape :math:`(K, 4, 4)`.
        frames: index of each keyframe's frame, -1 for one of an earlier run.
        camera: gives the frustums their shape.
    """
    right, bottom = camera.width - 0.5, camera.height - 0.5
    corners = torch.tensor([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [right / 2, -0.15 * bottom]])
    image = camera.back_project(corners.to(torch.float64), torch.full((5,), _LENGTH, dtype=torch.float64))
    shape = torch.cat([image.new_zeros(1, 3), image])  # the centre, the image's corners clockwise, a mark above it
    frustums = shape @ T_wk[:, :3, :3].mT + T_wk[:, None, :3, 3]
    first = len(trajectory) + len(shape) * torch.arange(len(T_wk))[:, None, None]
    colours = _colours(trajectory.stamps, statuses)
    step = torch.arange(len(trajectory))
    return CameraPath(
        points=torch.cat([trajectory.T_wc[:, :3, 3], frustums.flatten(0, 1)]),
        colours=torch.cat([colours[:-1], colours[frames].repeat_interleave(len(shape), dim=0)]),
        faces=(first + _SIDES).flatten(0, 1),
        edges=torch.cat([torch.stack([step[:-1], step[1:]], dim=1), (first + _LINES).flatten(0, 1)]),
    )


def _colours(stamps: Tensor, statuses: list[str]) -> Tensor:
    """RGB of each frame and, last, of an earlier run, uint8, shape (N + 1, 3)."""
    passed = (stamps - stamps[:1]) / (stamps[-1:] - stamps[:1]).clamp(min=1e-9)
    colours = [mpl.colormaps["viridis"](share)[:3] for share in passed.tolist()]
    chosen = [STATUS_COLOURS.get(status) for status in [*statuses, "earlier"]]
    colours = [to_rgb(colour) if colour else timed for colour, timed in zip(chosen, [*colours, (0, 0, 0)], strict=True)]
    return (255 * torch.tensor(colours)).round().to(torch.uint8)
