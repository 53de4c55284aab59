"""OpenLORIS-Scene: OpenCV's YAML, order of the intrinsics, conversion of base poses to camera poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.damaged_folders import assert_ground_truth_is_left_out, assert_rejected
from helpers.tiny_images import CAMERA_YAML, HEIGHT, WIDTH, as_rgb, colour_of, depth_of, save
from scipy.spatial.transform import Rotation

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.openloris import OpenLORISSequence
from v3d_torch.geometry.camera import PinholeCamera

SENSORS = f"""%YAML:1.0
t265_fisheye1_optical_frame:
   width: 848
d400_color_optical_frame:
   sensor_type: camera
   fps: 30
   width: {WIDTH}
   height: {HEIGHT}
   model: pinhole
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 30.5, 15.25,
          31.5, 11.75 ]
   distortion_model: radial-tangential
   distortion_coefficients: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 0.1, -0.2, 0.003, 0.004 ]
"""
TRANSFORMS = """%YAML:1.0
trans_matrix:
   -
      parent_frame: laser
      child_frame: base_link
      matrix: !!opencv-matrix
         rows: 4
         cols: 4
         dt: d
         data: [ 0., 1., 0., 0.2, -1., 0., 0., 0.0, 0., 0., 1., 0.1, 0., 0., 0., 1. ]
   -
      parent_frame: laser
      child_frame: d400_color_optical_frame
      matrix: !!opencv-matrix
         rows: 4
         cols: 4
         dt: d
         data: [ 0., 0., 1., 0.3, -1., 0., 0., 0.05, 0., -1., 0., 0.4, 0., 0., 0., 1. ]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "office1-1"
    for i in range(3):
        save(root / "color" / f"{i}.png", colour_of(i))
        save(root / "aligned_depth" / f"{i}.png", depth_of(i))
    (root / "color.txt").write_text(
        "#Time Filename\n" + "".join(f"15600000{i:02d}.5 color/{i}.png\n" for i in range(3))
    )
    (root / "aligned_depth.txt").write_text("".join(f"15600000{i:02d}.501 aligned_depth/{i}.png\n" for i in range(2)))
    (root / "groundtruth.txt").write_text("1560000000.4 1 2 0 0 0 0.6 0.8\n")
    (root / "sensors.yaml").write_text(SENSORS)
    (root / "trans_matrix.yaml").write_text(TRANSFORMS)
    return root


def test_openloris_frames_and_camera_match_files(folder: Path) -> None:
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, OpenLORISSequence)
    assert sequence.stamps.tolist() == [1560000000.5, 1560000001.5]
    assert sequence.camera == PinholeCamera(
        30.5, 31.5, 15.25, 11.75, WIDTH, HEIGHT, (0.1, -0.2, 0.003, 0.004, 0.0), depth_scale=1000
    )
    assert np.array_equal(as_rgb(sequence[1].image), colour_of(1))
    np.testing.assert_allclose(sequence[1].depth[0], depth_of(1) / 1000, rtol=1e-6)


def test_convention_ground_truth_is_of_the_camera(folder: Path) -> None:
    T_laser_base = np.array([[0, 1, 0, 0.2], [-1, 0, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    T_laser_camera = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0.05], [0, -1, 0, 0.4], [0, 0, 0, 1]])
    T_wb = np.eye(4)
    T_wb[:3, :3], T_wb[:3, 3] = Rotation.from_quat([0, 0, 0.6, 0.8]).as_matrix(), [1, 2, 0]
    groundtruth = load_sequence(str(folder)).groundtruth
    assert groundtruth is not None and groundtruth.stamps.tolist() == [1560000000.4]
    np.testing.assert_allclose(groundtruth.T_wc[0], T_wb @ np.linalg.inv(T_laser_base) @ T_laser_camera, atol=1e-12)


def test_camera_chosen_by_user_replaces_sensors_file(folder: Path) -> None:
    (folder / "sensors.yaml").write_text("%YAML:1.0\nnothing: 1\n")
    own = PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT, depth_scale=2000)
    assert load_sequence(str(folder), camera=own).camera is own
    (folder / "camera.yaml").write_text(CAMERA_YAML)
    assert load_sequence(str(folder)).camera == PinholeCamera(30, 31, 15.5, 11.5, WIDTH, HEIGHT, depth_scale=1000)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "aligned_depth.txt").unlink(), "has no aligned_depth.txt"),
        (lambda f: (f / "sensors.yaml").write_text("%YAML:1.0\nx: 1\n"), "sensors.yaml: has no d400_color"),
        (lambda f: (f / "sensors.yaml").write_text(SENSORS.replace("30.5", "-30.5")), "sensors.yaml: fx: .*-30.5"),
        (lambda f: (f / "aligned_depth" / "1.png").unlink(), "1.png: is listed but does not exist"),
    ],
)
def test_damaged_openloris_folder_is_rejected(folder: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(folder)
    assert_rejected(folder, message)


@pytest.mark.parametrize(
    ("transforms", "message"),
    [
        (None, "cannot be read"),
        ("{", "is not valid OpenCV YAML"),
        ("%YAML:1.0\nx: 1\n", "has no transform from d400_color_optical_frame to base_link"),
        ("%YAML:1.0\ntrans_matrix:\n   - { parent_frame: a }\n", "a transform has no"),
    ],
)
def test_invalid_calibration_gives_no_ground_truth(folder: Path, transforms: str | None, message: str) -> None:
    file = folder / "trans_matrix.yaml"
    file.unlink() if transforms is None else file.write_text(transforms)
    assert_ground_truth_is_left_out(folder, file, message)
