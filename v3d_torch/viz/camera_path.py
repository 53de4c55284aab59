"""Camera path as a mesh for PLY viewers: a line through all frames, and a frustum at each keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import torch
from matplotlib.colors import to_rgb
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.types import Trajectory

PATH_COLOURS = {"odometry": "#ff7f0e", "disconnected": "#d62728", "lost": "#d62728", "earlier": "#7f7f7f"}
"""Colour of frames that are not tracked, and of keyframes of an earlier run. The colour of tracked frames changes from
dark blue to yellow with time."""

FRUSTUM_DEPTH = 0.08
"""Distance from the camera centre to the drawn image plane, metres: visible but not dominant at the size of a room."""

# Vertices of a frustum: 0 is the camera centre, 1-4 are the image corners clockwise, 5 is a mark above the image.
_FACES = torch.tensor([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 5]])
_EDGES = torch.tensor([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [1, 5], [5, 2]])


@dataclass(frozen=True)
class CameraPath:
    """Coloured vertices with triangles and lines between them.

    Attributes:
        points: Vertices, world frame, metres, float64, shape :math:`(N, 3)`.
        colours: RGB of the vertices, uint8, shape :math:`(N, 3)`.
        faces: Vertex indices of the sides of the frustums, int64, shape :math:`(F, 3)`.
        edges: Vertex indices of the lines of the frustums and between consecutive frames, int64, shape :math:`(E, 2)`.
    """

    points: Tensor
    colours: Tensor
    faces: Tensor
    edges: Tensor


def make_camera_path(
    trajectory: Trajectory, statuses: Sequence[str], T_wk: Tensor, positions: Tensor, camera: PinholeCamera
) -> CameraPath:
    """Create the mesh of a camera path.

    Args:
        trajectory: Poses of all frames.
        statuses: Tracking status of each frame: "tracked", or a key of `PATH_COLOURS`.
        T_wk: Camera-to-world poses of the keyframes, float64, shape :math:`(K, 4, 4)`.
        positions: Position of each keyframe in the trajectory, -1 for one of an earlier run, int64, shape :math:`(K,)`.
        camera: Camera, which determines the shape of the frustums.
    """
    right, bottom = camera.width - 0.5, camera.height - 0.5
    corners = torch.tensor([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [right / 2, -0.15 * bottom]])
    image = camera.back_project(corners.to(torch.float64), torch.full((5,), FRUSTUM_DEPTH, dtype=torch.float64))
    frustum = torch.cat([image.new_zeros(1, 3), image])
    frustums = transform_points(T_wk, frustum)
    first_vertex = len(trajectory) + len(frustum) * torch.arange(len(T_wk))[:, None, None]
    colours = _colours(trajectory.stamps, statuses)
    indices = torch.arange(len(trajectory))
    return CameraPath(
        points=torch.cat([trajectory.T_wc[:, :3, 3], frustums.flatten(0, 1)]),
        colours=torch.cat([colours[:-1], colours[positions].repeat_interleave(len(frustum), dim=0)]),
        faces=(first_vertex + _FACES).flatten(0, 1),
        edges=torch.cat([torch.stack([indices[:-1], indices[1:]], dim=1), (first_vertex + _EDGES).flatten(0, 1)]),
    )


def _colours(stamps: Tensor, statuses: Sequence[str]) -> Tensor:
    """Return the RGB of each frame and, in the last row, of an earlier run, uint8, shape (N + 1, 3)."""
    progress = (stamps - stamps[:1]) / (stamps[-1:] - stamps[:1]).clamp(min=1e-9)
    by_time = [*(mpl.colormaps["viridis"](fraction)[:3] for fraction in progress.tolist()), (0, 0, 0)]
    by_status = [PATH_COLOURS.get(status) for status in [*statuses, "earlier"]]
    colours = [to_rgb(fixed) if fixed else timed for fixed, timed in zip(by_status, by_time, strict=True)]
    return (255 * torch.tensor(colours)).round().to(torch.uint8)
