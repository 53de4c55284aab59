"""PLY files read back by another library, and the camera's way as frustums."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from matplotlib import colormaps
from torch import Tensor

from v3d_torch.errors import OutputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.io.ply import write_ply
from v3d_torch.types import Trajectory
from v3d_torch.viz.camera_path import PATH_COLOURS, CameraPath, make_camera_path

CAMERA = PinholeCamera(fx=500.0, fy=510.0, cx=300.0, cy=250.0)


def columns(element: plyfile.PlyElement, *names: str) -> np.ndarray:
    return np.stack([element[name] for name in names], axis=1)


# --- files


def test_everything_is_read_back(tmp_path: Path) -> None:
    points = torch.randn(5, 3, dtype=torch.float64)
    colours = torch.randint(0, 256, (5, 3), dtype=torch.uint8)
    normals = torch.randn(5, 3)
    faces, edges = torch.tensor([[0, 1, 2], [2, 3, 4]]), torch.tensor([[0, 4], [1, 3], [2, 2]])
    write_ply(tmp_path / "all.ply", points, colours, normals=normals, faces=faces, edges=edges)
    read = plyfile.PlyData.read(tmp_path / "all.ply")
    assert not read.text and read.byte_order == "<"
    vertex = read["vertex"]
    np.testing.assert_array_equal(columns(vertex, "x", "y", "z"), points.float().numpy())
    np.testing.assert_array_equal(columns(vertex, "nx", "ny", "nz"), normals.numpy())
    np.testing.assert_array_equal(columns(vertex, "red", "green", "blue"), colours.numpy())
    np.testing.assert_array_equal(np.stack(read["face"]["vertex_indices"]), faces.numpy())
    np.testing.assert_array_equal(columns(read["edge"], "vertex1", "vertex2"), edges.numpy())
    read.write(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "all.ply").read_bytes()


def test_what_is_not_given_is_not_written(tmp_path: Path) -> None:
    write_ply(tmp_path / "points.ply", torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    read = plyfile.PlyData.read(tmp_path / "points.ply")
    assert [element.name for element in read] == ["vertex"] and read["vertex"].count == 0
    assert [held.name for held in read["vertex"].properties] == ["x", "y", "z", "red", "green", "blue"]


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"map\.ply: cannot be written"):
        write_ply(tmp_path / "file" / "map.ply", torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8))


# --- the camera's way


def drawn(frames: int = 10, keyframes: tuple[int, ...] = (0, 6), statuses: list[str] | None = None) -> CameraPath:
    trajectory = way(frames)
    T_wk = trajectory.T_wc[list(keyframes)]
    return make_camera_path(trajectory, statuses or frames * ["tracked"], T_wk, list(keyframes), CAMERA)


def way(frames: int) -> Trajectory:
    twists = torch.arange(frames)[:, None] * torch.tensor([0.1, 0.02, 0.03, 0.05, -0.1, 0.2], dtype=torch.float64)
    return Trajectory(torch.arange(frames, dtype=torch.float64), se3_exp(twists))


def test_frustums_show_the_field_of_view() -> None:
    path = drawn()
    frustums = path.points[10:].reshape(2, 6, 3)
    for T_wc, frustum in zip(way(10).T_wc[[0, 6]], frustums, strict=True):
        torch.testing.assert_close(frustum[0], T_wc[:3, 3])
        in_camera = (frustum[1:] - T_wc[:3, 3]) @ T_wc[:3, :3]
        assert (in_camera[:, 2] - in_camera[0, 2]).abs().max() < 1e-9 and in_camera[0, 2] > 0
        uv = CAMERA.project(in_camera)
        corners = torch.tensor([[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]], dtype=torch.float64)
        torch.testing.assert_close(uv[:4], corners)
        assert uv[4, 1] < -10 and 300 < uv[4, 0] < 340  # the mark is above the image's middle


def test_sides_face_outwards_and_stay_within_their_frustum() -> None:
    path = drawn()
    assert path.faces.shape == (10, 3)
    for first, faces in ((10, path.faces[:5]), (16, path.faces[5:])):
        assert faces.min() == first and faces.max() == first + 5
        middle = path.points[first : first + 5].mean(dim=0)
        for face in faces[:4]:
            a, b, c = path.points[face]
            assert torch.linalg.cross(b - a, c - a) @ (a - middle) > 0


def test_lines_join_the_frames_in_order() -> None:
    path = drawn()
    steps = [[i, i + 1] for i in range(9)]
    assert path.edges[:9].tolist() == steps
    torch.testing.assert_close(path.points[:10], way(10).T_wc[:, :3, 3])
    assert path.edges[9:].min() == 10 and path.edges.max() == len(path.points) - 1


def rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


def test_colours_tell_time_and_trouble() -> None:
    statuses = [*4 * ["tracked"], "lost", "disconnected", "odometry", *3 * ["tracked"]]
    path = drawn(statuses=statuses, keyframes=(0, 6, 9))
    assert path.colours.shape == path.points.shape and path.colours.dtype == torch.uint8
    for row, status in enumerate(statuses):
        timed = [round(255 * value) for value in colormaps["viridis"](row / 9)[:3]]
        assert path.colours[row].tolist() == (timed if status == "tracked" else rgb(PATH_COLOURS[status])), row
    for frame, colours in zip((0, 6, 9), path.colours[10:].reshape(3, 6, 3), strict=True):
        assert torch.equal(colours, path.colours[frame].expand(6, 3))


def test_keyframes_of_an_earlier_run_are_grey() -> None:
    trajectory = way(3)
    T_wk: Tensor = trajectory.T_wc
    path = make_camera_path(trajectory, 3 * ["tracked"], T_wk, [-1, -1, 2], CAMERA)
    assert path.colours[3:15].unique(dim=0).tolist() == [rgb(PATH_COLOURS["earlier"])]
    assert torch.equal(path.colours[15], path.colours[2])


@pytest.mark.parametrize("frames", [0, 1])
def test_hardly_any_frames(frames: int) -> None:
    path = drawn(frames, keyframes=tuple(range(frames)))
    assert len(path.points) == 7 * frames and len(path.faces) == 5 * frames and len(path.edges) == 10 * frames
