"""Camera trajectory as lines and frustums."""

from __future__ import annotations

import pytest
import torch
from matplotlib import colormaps
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory
from v3d_torch.viz.camera_path import PATH_COLOURS, CameraPath, make_camera_path

CAMERA = PinholeCamera(fx=500.0, fy=510.0, cx=300.0, cy=250.0)


def draw_path(frames: int = 10, keyframes: tuple[int, ...] = (0, 6), statuses: list[str] | None = None) -> CameraPath:
    trajectory = trajectory_of(frames)
    T_wk = trajectory.T_wc[list(keyframes)]
    return make_camera_path(
        trajectory, statuses or frames * ["tracked"], T_wk, torch.tensor(keyframes, dtype=torch.int64), CAMERA
    )


def trajectory_of(frames: int) -> Trajectory:
    twists = torch.arange(frames)[:, None] * torch.tensor([0.1, 0.02, 0.03, 0.05, -0.1, 0.2], dtype=torch.float64)
    return Trajectory(torch.arange(frames, dtype=torch.float64), se3_exp(twists))


def test_frustums_match_the_field_of_view() -> None:
    path = draw_path()
    frustums = path.points[10:].reshape(2, 6, 3)
    for T_wc, frustum in zip(trajectory_of(10).T_wc[[0, 6]], frustums, strict=True):
        torch.testing.assert_close(frustum[0], T_wc[:3, 3])
        in_camera = (frustum[1:] - T_wc[:3, 3]) @ T_wc[:3, :3]
        assert (in_camera[:, 2] - in_camera[0, 2]).abs().max() < 1e-9 and in_camera[0, 2] > 0
        uv = CAMERA.project(in_camera)
        corners = torch.tensor([[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]], dtype=torch.float64)
        torch.testing.assert_close(uv[:4], corners)
        assert uv[4, 1] < -10 and 300 < uv[4, 0] < 340  # the up marker is above the middle of the image


def test_faces_point_outwards_and_use_only_their_frustum() -> None:
    path = draw_path()
    assert path.faces.shape == (10, 3)
    for first, faces in ((10, path.faces[:5]), (16, path.faces[5:])):
        assert faces.min() == first and faces.max() == first + 5
        middle = path.points[first : first + 5].mean(dim=0)
        for face in faces[:4]:
            a, b, c = path.points[face]
            assert torch.linalg.cross(b - a, c - a) @ (a - middle) > 0


def test_edges_join_consecutive_frames() -> None:
    path = draw_path()
    steps = [[i, i + 1] for i in range(9)]
    assert path.edges[:9].tolist() == steps
    torch.testing.assert_close(path.points[:10], trajectory_of(10).T_wc[:, :3, 3])
    assert path.edges[9:].min() == 10 and path.edges.max() == len(path.points) - 1


def test_edges_of_a_frustum_join_its_neighbouring_vertices() -> None:
    """The centre (0) with each corner (1 to 4), the corners in their order, and the mark (5) with the upper corners."""
    expected = {(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (1, 4), (1, 5), (2, 5)}
    edges = draw_path().edges
    for first, own in ((10, edges[9:19]), (16, edges[19:])):
        assert {tuple(sorted(edge)) for edge in (own - first).tolist()} == expected


def rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def test_colours_show_time_or_tracking_failures() -> None:
    statuses = [*4 * ["tracked"], "lost", "disconnected", "odometry", *3 * ["tracked"]]
    path = draw_path(statuses=statuses, keyframes=(0, 6, 9))
    assert path.colours.shape == path.points.shape and path.colours.dtype == torch.uint8
    for row, status in enumerate(statuses):
        time_colour = [round(255 * value) for value in colormaps["viridis"](row / 9)[:3]]
        assert path.colours[row].tolist() == (time_colour if status == "tracked" else rgb(PATH_COLOURS[status])), row
    for frame, colours in zip((0, 6, 9), path.colours[10:].reshape(3, 6, 3), strict=True):
        assert torch.equal(colours, path.colours[frame].expand(6, 3))


def test_keyframes_of_an_earlier_run_have_their_own_colour() -> None:
    trajectory = trajectory_of(3)
    T_wk: Tensor = trajectory.T_wc
    path = make_camera_path(trajectory, 3 * ["tracked"], T_wk, torch.tensor([-1, -1, 2]), CAMERA)
    assert path.colours[3:15].unique(dim=0).tolist() == [rgb(PATH_COLOURS["earlier"])]
    assert torch.equal(path.colours[15], path.colours[2])


@pytest.mark.parametrize("frames", [0, 1])
def test_paths_of_zero_and_one_frame_are_drawn(frames: int) -> None:
    path = draw_path(frames, keyframes=tuple(range(frames)))
    assert len(path.points) == 7 * frames and len(path.faces) == 5 * frames and len(path.edges) == 10 * frames
