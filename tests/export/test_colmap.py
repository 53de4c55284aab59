"""Text models of COLMAP, read back and projected with OpenCV's camera models, and with pycolmap if it is installed."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.colmap_reader import ColmapModel, read_model, read_with_pycolmap
from helpers.posed_images import CAMERA, COLOURS, DISTORTED, FISHEYE, POINTS, T_WC, posed_images
from torch import Tensor

from v3d_torch.export.colmap import write_colmap
from v3d_torch.export.landmark_tracks import LandmarkTracks
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert

CAMERAS = {
    "PINHOLE": CAMERA,
    "OPENCV": replace(DISTORTED, distortion=(0.26, -0.2, -0.005, 0.003, 0.0)),
    "FULL_OPENCV": DISTORTED,
    "OPENCV_FISHEYE": FISHEYE,
}
SHIFT = torch.tensor([0.3, 0.4], dtype=torch.float64)
"""Error of all image points, pixels."""


def make_tracks(camera: PinholeCamera, points: Tensor = POINTS[:3]) -> LandmarkTracks:
    """Three points, observed in both images."""
    T_cw = invert(T_WC)
    first, second = (camera.project(points @ T[:3, :3].T + T[:3, 3]) + SHIFT for T in T_cw)
    image, landmark = torch.tensor([0, 0, 0, 1, 1, 1]), torch.tensor([0, 1, 2, 2, 1, 0])
    return LandmarkTracks(points, image, landmark, torch.cat([first, second.flip(0)]))


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, ColmapModel]]:
    """Folder and model of each camera."""
    models = {}
    dense = POINTS[3:].float(), torch.from_numpy(COLOURS[3:])
    for name, camera in CAMERAS.items():
        folder = tmp_path_factory.mktemp(name)
        write_colmap(folder, camera, posed_images(camera), dense, make_tracks(camera))
        models[name] = folder, read_model(folder / "sparse" / "0", POINTS.numpy())
    return models


@pytest.fixture(scope="module")
def model(exports: dict[str, tuple[Path, ColmapModel]]) -> ColmapModel:
    return exports["PINHOLE"][1]


@pytest.mark.parametrize("name", CAMERAS)
def test_convention_points_project_to_their_pixels_by_the_camera_model_of_colmap(
    name: str, exports: dict[str, tuple[Path, ColmapModel]]
) -> None:
    folder, model = exports[name]
    assert model.camera[0] == name
    for file, image in model.images.items():
        picture = cv2.imread(str(folder / "images" / file))[..., ::-1]
        for uv, colour in zip(image["projections"], COLOURS, strict=True):
            u, v = np.floor(uv).astype(int)  # the centre of the first pixel is at 0.5
            np.testing.assert_array_equal(picture[v - 2 : v + 3, u - 2 : u + 3], np.broadcast_to(colour, (5, 5, 3)))


@pytest.mark.parametrize("name", CAMERAS)
def test_convention_image_points_are_near_the_projections_of_their_landmarks(
    name: str, exports: dict[str, tuple[Path, ColmapModel]]
) -> None:
    for image in exports[name][1].images.values():
        assert len(image["points"]) == 3
        for x, y, number in image["points"]:
            offset = np.array([x, y]) - image["projections"][number - 1]
            np.testing.assert_allclose(offset, SHIFT, atol=0.2 if "OPENCV" in name else 1e-3)


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed")
@pytest.mark.parametrize("name", CAMERAS)
def test_pycolmap_reads_the_same_model(name: str, exports: dict[str, tuple[Path, ColmapModel]]) -> None:
    folder, model = exports[name]
    theirs = read_with_pycolmap(folder / "sparse" / "0", POINTS.numpy())
    assert theirs.camera == model.camera and theirs.images.keys() == model.images.keys()
    assert theirs.points.keys() == model.points.keys()
    for file, image in model.images.items():
        for key in ("T_cw", "points", "projections"):
            np.testing.assert_allclose(theirs.images[file][key], image[key], rtol=0, atol=1e-6)
    for number, point in model.points.items():
        assert {key: theirs.points[number][key] for key in ("xyz", "color", "track")} == {
            key: point[key] for key in ("xyz", "color", "track")
        }


def test_poses_are_world_to_camera(model: ColmapModel) -> None:
    for (_, image), T_cw in zip(sorted(model.images.items()), invert(T_WC), strict=True):
        np.testing.assert_allclose(image["T_cw"], T_cw[:3], atol=1e-10)


def test_landmarks_have_tracks_colours_and_errors(model: ColmapModel) -> None:
    for number in (1, 2, 3):
        point = model.points[number]
        np.testing.assert_allclose(point["xyz"], POINTS[number - 1], atol=1e-6)
        assert point["color"] == COLOURS[number - 1].tolist()
        assert point["error"] == pytest.approx(0.5, abs=1e-3)
        assert {name for name, _ in point["track"]} == set(model.images)
        for name, index in point["track"]:
            assert model.images[name]["points"][index][2] == number


@pytest.mark.parametrize("name", CAMERAS)
def test_convention_errors_are_distances_to_the_image_points_by_the_camera_model_of_colmap(
    name: str, exports: dict[str, tuple[Path, ColmapModel]]
) -> None:
    model = exports[name][1]
    for number in (1, 2, 3):
        images = [(model.images[file], index) for file, index in model.points[number]["track"]]
        offsets = [image["projections"][number - 1] - image["points"][index][:2] for image, index in images]
        assert model.points[number]["error"] == pytest.approx(np.linalg.norm(offsets, axis=1).mean(), abs=2e-4)


def test_points_of_the_map_follow_without_tracks(model: ColmapModel) -> None:
    assert sorted(model.points) == [1, 2, 3, 4, 5]
    for number in (4, 5):
        np.testing.assert_allclose(model.points[number]["xyz"], POINTS[number - 1], atol=1e-5)
        assert (model.points[number]["color"], model.points[number]["track"]) == (COLOURS[number - 1].tolist(), [])


def test_masks_are_named_by_image_and_black_where_something_moves(
    exports: dict[str, tuple[Path, ColmapModel]],
) -> None:
    folder, model = exports["PINHOLE"]
    for name in model.images:
        mask = cv2.imread(str(folder / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert (mask[:, :40] == 0).all() and (mask[:, 40:] == 255).all()


def test_landmarks_are_not_observed_on_what_moves(tmp_path: Path) -> None:
    """The first point is masked in both images, the second in one; only the third one is left."""
    tracks = make_tracks(CAMERA, POINTS[[4, 1, 0]])
    first, second = posed_images()
    u, v = tracks.uv[4].round().to(torch.int64).tolist()
    static = second.static.clone()
    static[v, u] = False
    none = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)
    write_colmap(tmp_path, CAMERA, [first, replace(second, static=static)], none, tracks)
    model = read_model(tmp_path / "sparse" / "0")
    (point,) = model.points.values()
    np.testing.assert_allclose(point["xyz"], POINTS[0], atol=1e-6)
    assert point["color"] == COLOURS[0].tolist() and point["error"] == pytest.approx(0.5, abs=1e-3)
    assert sorted(point["track"]) == [[name, 0] for name in sorted(model.images)]
    for image in model.images.values():
        ((*_, number),) = image["points"]
        assert model.points[number] is point


def test_image_point_at_the_right_edge_has_the_colour_of_the_last_column(tmp_path: Path) -> None:
    """It is rounded to the column behind the image."""
    uv = torch.tensor([[CAMERA.width - 0.5, 60.0]] * 2, dtype=torch.float64)
    tracks = LandmarkTracks(POINTS[:1], torch.tensor([0, 1]), torch.tensor([0, 0]), uv)
    images = posed_images()
    images[1].frame.image[:, 60, -1] = torch.tensor([10, 20, 30])
    write_colmap(tmp_path, CAMERA, images, (torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)), tracks)
    assert read_model(tmp_path / "sparse" / "0").points[1]["color"] == [10, 20, 30]


def test_large_map_is_thinned_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v3d_torch.export.colmap._MAX_POINTS", 4)
    points, colours = torch.arange(30.0).reshape(10, 3), torch.zeros(10, 3, dtype=torch.uint8)
    none = torch.zeros(0, dtype=torch.int64)
    nothing = LandmarkTracks(torch.zeros(0, 3).double(), none, none, torch.zeros(0, 2).double())
    write_colmap(tmp_path, CAMERA, posed_images(), (points, colours), nothing)
    written = [point["xyz"][0] for _, point in sorted(read_model(tmp_path / "sparse" / "0").points.items())]
    assert written == [0, 9, 18, 27]


def test_image_point_outside_of_the_image_is_left_out(tmp_path: Path) -> None:
    """Features beside the border of a distorted image are outside of the undistorted one."""
    edge = CAMERA.width - 0.5
    uv = torch.tensor([[edge, 60.0], [-47.6, -30.9], [edge, 60.0], [edge, 123.0]], dtype=torch.float64)
    tracks = LandmarkTracks(POINTS[:1], torch.tensor([0, 0, 1, 1]), torch.tensor([0, 0, 0, 0]), uv)
    write_colmap(tmp_path, CAMERA, posed_images(), (torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)), tracks)
    model = read_model(tmp_path / "sparse" / "0")
    assert [len(image["points"]) for _, image in sorted(model.images.items())] == [1, 1]
