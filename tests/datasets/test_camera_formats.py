"""Camera files of ORB-SLAM, Kalibr, ROS and OpenCV, and plain numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.camera_files import CAMERA, FILES, FISHEYE, KALIBR, LENS, ORB_SLAM2, ORB_SLAM3, ROS, ROS_TOPIC
from helpers.tiny_images import CAMERA_YAML

from v3d_torch.datasets.cameras import choose_camera, load_camera
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera


def load(folder: Path, text: str, name: str = "camera.yaml") -> PinholeCamera:
    (folder / name).write_text(text, encoding="utf-8")
    return load_camera(folder / name)


@pytest.mark.parametrize("program", FILES)
def test_camera_of_another_program_is_read(tmp_path: Path, program: str) -> None:
    text, depth_scale = FILES[program]
    distortion = (*LENS[:4], 0.0) if program == "Kalibr" else LENS
    assert load(tmp_path, text) == replace(CAMERA, distortion=distortion, depth_scale=depth_scale)


@pytest.mark.parametrize("prefix", ["Camera", "Camera1"])
def test_orb_slam_settings_equal_those_that_opencv_reads(tmp_path: Path, prefix: str) -> None:
    text = ORB_SLAM2 if prefix == "Camera" else ORB_SLAM3
    camera = load(tmp_path, text)
    settings = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    for name, value in zip(("fx", "fy", "cx", "cy"), camera.intrinsics, strict=False):
        assert settings.getNode(f"{prefix}.{name}").real() == value
    lens = [settings.getNode(f"{prefix}.{name}").real() for name in ("k1", "k2", "p1", "p2", "k3")]
    assert camera.distortion == tuple(lens)


def test_fisheye_of_orb_slam3_and_kalibr_is_read(tmp_path: Path) -> None:
    expected = replace(CAMERA, distortion=FISHEYE, distortion_model="equidistant")
    names = dict(zip(("k1", "k2", "p1", "p2"), ("k1", "k2", "k3", "k4"), strict=True))
    lines = [line for line in ORB_SLAM3.splitlines() if not line.startswith("Camera1.k3")]
    text = "\n".join(lines).replace("PinHole", "KannalaBrandt8")
    for (old, new), before, value in zip(names.items(), LENS, FISHEYE, strict=False):
        text = text.replace(f"Camera1.{old}: {before}", f"Camera1.{new}: {value}")
    assert load(tmp_path, text) == replace(expected, depth_scale=5000)
    text = KALIBR.replace("radtan", "equidistant").replace(str(list(LENS[:4])), str(list(FISHEYE)))
    assert load(tmp_path, text) == expected


def test_rational_model_of_ros_is_read(tmp_path: Path) -> None:
    coefficients = (*LENS, 0.1, 0.2, 0.3)
    text = ROS.replace("plumb_bob", "rational_polynomial").replace(str(list(LENS)), str(list(coefficients)))
    camera = load(tmp_path, text)
    assert (camera.distortion, camera.distortion_model) == (coefficients, "rational_polynomial")


@pytest.mark.parametrize("text", [KALIBR, ROS, ORB_SLAM2.replace("DepthMapFactor: 5000.0", "")])
def test_values_that_other_programs_do_not_state_can_be_added(tmp_path: Path, text: str) -> None:
    added = {"depth_scale": 1000, "readout": 0.02, "depth_delay": -0.008, "inverse_depth_offset": 0.004}
    camera = load(tmp_path, "\n".join([text, *(f"{name}: {value}" for name, value in added.items())]))
    assert {name: getattr(camera, name) for name in added} == added


@pytest.mark.parametrize(
    "name", ["dist_coeffs", "distCoeffs", "dist_coeff", "distortion_coeffs", "distortion", "dist", "D"]
)
def test_distortion_is_read_under_all_usual_names(tmp_path: Path, name: str) -> None:
    assert load(tmp_path, ROS.replace("distortion_coefficients", name)) == CAMERA


@pytest.mark.parametrize("name", ["distortion_parameters", "dist_vector"])
def test_distortion_under_another_name_is_rejected(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=rf"camera\.yaml: has an unknown key {name}; name .* distortion_coefficients"):
        load(tmp_path, ROS.replace("distortion_coefficients", name))


def test_matrices_with_a_list_for_each_row_are_read(tmp_path: Path) -> None:
    camera = replace(CAMERA, depth_scale=1000)
    rows = f"[[{camera.fx}, 0, {camera.cx}], [0, {camera.fy}, {camera.cy}], [0, 0, 1]]"
    text = f"camera_matrix: {rows}\ndist_coeff: [{list(LENS)}]\nimage_width: 640\nimage_height: 480\n"
    assert load(tmp_path, text + "depth_scale: 1000\n") == camera


def test_several_messages_of_a_topic_are_one_camera(tmp_path: Path) -> None:
    assert load(tmp_path, 3 * ROS_TOPIC) == CAMERA


@pytest.mark.parametrize("text", ["500 510 32 24\n", "500 0 32\n0 510 24\n0 0 1\n", ORB_SLAM2])
def test_size_that_a_file_does_not_state_is_that_of_the_images(tmp_path: Path, text: str) -> None:
    is_yaml = text is ORB_SLAM2
    path = tmp_path / ("camera.yaml" if is_yaml else "K.txt")
    lines = [line for line in text.splitlines() if "width" not in line and "height" not in line]
    path.write_text("\n".join(lines))
    size = (640, 512) if is_yaml else (64, 48)
    camera = choose_camera(None, tmp_path, image_size=lambda: size)
    assert (camera.width, camera.height) == size
    assert (load_camera(path).width, load_camera(path).height) == (640, 480)
    with pytest.raises(InputError, match=r"principal point .* is far from the centre of the 320x240 images; give the"):
        choose_camera(None, tmp_path, image_size=lambda: (320, 240))


def test_numbers_without_a_depth_scale_are_read(tmp_path: Path) -> None:
    camera = load(tmp_path, "500 510 32 24 64 48\n", "K.txt")
    assert camera == PinholeCamera(500, 510, 32, 24, 64, 48)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (KALIBR + KALIBR.replace("cam0", "cam1"), r"contains 2 cameras \(cam0, cam1\); keep only the colour camera"),
        (KALIBR.replace("pinhole", "omni"), "has the camera model omni, which is not supported; calibrate with"),
        (KALIBR.replace("radtan", "fov"), "the distortion model fov is not supported; calibrate with one of"),
        (KALIBR.replace("intrinsics", "focal"), r"is an incomplete camera file \('intrinsics' is missing\); export it"),
        (KALIBR.replace("318.64304, ", ""), r"is an incomplete camera file \(not enough values to unpack"),
        (ORB_SLAM2.replace("Camera.cy", "#"), r"is an incomplete camera file \('Camera.cy' is missing\)"),
        (ORB_SLAM2.replace("Camera.k1: 0.262383", "Camera.k1: wide"), "could not convert string to float: 'wide'"),
        (ORB_SLAM2.replace("Camera.k1: 0.262383", "Camera.k1: yes"), r"incomplete camera file \(True is not a number"),
        (ROS.replace("data: [517.306408, 0, ", "data: [true, 0, "), r"incomplete camera file \(True is not a number"),
        (ORB_SLAM2.replace("Camera.fx: 517", "Camera.fx: -517"), "fx: input should be greater than or equal to 1"),
        (ORB_SLAM2.replace("Factor: 5000.0", "Factor: 0.0002"), "depth_scale: input should be greater than or equal"),
        (ROS.replace("data: [517.306408, 0, ", "data: ["), r"contains|incomplete camera file|fy: "),
        (ROS.replace("camera_matrix:", "camera_matrix: 5\nx:"), "is an incomplete camera file"),
        (
            CAMERA_YAML.replace("fy: 31", "fy: -31"),
            "fy is -31; a negative fy, as published with ICL-NUIM, means that y",
        ),
        (ORB_SLAM2.replace("fy: 516", "fy: -516"), "fy is -516.469215; a negative fy, .* so give its absolute value"),
        (CAMERA_YAML + "distortion: [0.1, 0, 0, 0]\n", "distortion has 4 numbers; write k1, k2, p1, p2, k3, or state"),
        (CAMERA_YAML + "distortion_model: fov\ndistortion: [0.9]\n", "the distortion model fov is not supported"),
        (
            CAMERA_YAML + f"distortion: {list(range(1, 13))}\n",
            "has 12 coefficients, the model rational_polynomial has 8",
        ),
    ],
)
def test_invalid_camera_of_another_program_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=f"^{tmp_path}/camera.yaml: .*{message}") as caught:
        load(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_four_coefficients_with_their_model_are_read(tmp_path: Path) -> None:
    text = CAMERA_YAML + "distortion: [0.1, 0.01, 0, 0]\ndistortion_model: "
    assert load(tmp_path, text + "plumb_bob").distortion == (0.1, 0.01, 0, 0, 0)
    assert load(tmp_path, text + "equidistant").distortion == (0.1, 0.01, 0, 0)


def test_fisheye_with_corners_behind_the_camera_is_rejected(tmp_path: Path) -> None:
    text = CAMERA_YAML.replace("30.0", "9").replace("31", "9")
    (tmp_path / "camera.yaml").write_text(text + "distortion_model: equidistant\n")
    with pytest.raises(InputError, match=r"cannot be inverted .*, or crop the images to less than 170 degrees"):
        choose_camera(None, tmp_path)


def test_odd_spaces_in_camera_files_are_spaces(tmp_path: Path) -> None:
    text = CAMERA_YAML.replace("fx: ", "fx:\u00a0").replace("cy: ", "cy:\u202f ").replace("31", "31\u200b")
    assert load(tmp_path, text) == PinholeCamera(30, 31, 15.5, 11.5, 32, 24, depth_scale=1000)
    assert load(tmp_path, "30\u00a031\u200315.5 11.5\u200b 1000 32 24", "K.txt").fx == 30


def test_matrix_of_numpy_equals_the_numbers(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "K.txt", np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]))
    assert load_camera(tmp_path / "K.txt") == PinholeCamera(500, 510, 320, 240)


@pytest.mark.parametrize(
    "start", ["# My camera\n---\n", "%YAML 1.2\n---\n", "# My camera\n\n--- # of the robot\n", "---\n---\n"]
)
def test_document_can_start_after_comments_and_directives(tmp_path: Path, start: str) -> None:
    assert load(tmp_path, start + CAMERA_YAML + "---\nfx: 1\n") == load(tmp_path, CAMERA_YAML, "plain.yaml")


@pytest.mark.parametrize(
    "matrix", ["[500, 0, 0, 0, 500, 0, 320, 240, 1]", "[500, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0]"]
)
def test_camera_matrix_in_another_order_is_rejected(tmp_path: Path, matrix: str) -> None:
    """Transposed, as MATLAB has it, its principal point would be (0, 0)."""
    text = f"width: 640\nheight: 480\nK: {matrix}\nD: [0, 0, 0, 0, 0]\n"
    with pytest.raises(InputError, match="the camera matrix is not 3x3 with the last row 0 0 1"):
        load(tmp_path, text)
