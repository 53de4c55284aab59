"""Cameras in files of other programs, lens models, and depth scales."""

from __future__ import annotations

from helpers.corpus.base import FOCAL, HEIGHT, SCALE, WIDTH
from helpers.corpus.cameras import YAML, field, numbers
from helpers.corpus.case import (
    Case,
    Damage,
    Fails,
    Succeeds,
    add_options,
    all_of,
    edit,
    rename,
    replace_text,
    write,
)

CX, CY = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
MATRIX = f"{FOCAL} 0 {CX}\n0 {FOCAL} {CY}\n0 0 1\n"
ORB_SLAM2 = (
    f'%YAML:1.0\n\nCamera.type: "PinHole"\nCamera.fx: {FOCAL}\nCamera.fy: {FOCAL}\nCamera.cx: {CX}\nCamera.cy: {CY}\n'
    f"Camera.width: {WIDTH}\nCamera.height: {HEIGHT}\nDepthMapFactor: {SCALE}.0\n"
    "Tbc: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: f\n   data: [1.]\n"
)
ORB_SLAM3 = ORB_SLAM2.replace("Camera.f", "Camera1.f").replace("Camera.c", "Camera1.c")
NO_SIZE = ORB_SLAM2.replace("Camera.width", "#").replace("Camera.height", "#")
KALIBR = (
    "cam0:\n  camera_model: pinhole\n  distortion_coeffs: [0, 0, 0, 0]\n  distortion_model: radtan\n"
    f"  intrinsics: [{FOCAL}, {FOCAL}, {CX}, {CY}]\n  resolution: [{WIDTH}, {HEIGHT}]\n"
)
ROS = (
    f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ndistortion_model: plumb_bob\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    f"  data: [{FOCAL}, 0, {CX}, 0, {FOCAL}, {CY}, 0, 0, 1]\n"
    "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
)
STATED = f"depth_scale: {SCALE}\n"
NO_SCALE = Fails(
    "{seq}: the unit of depth is not stated and cannot be estimated from the images (8 depth images with values from"
    " 5000 to 5000, median 5000); write the line depth_scale: 1000 into camera.yaml if depth is in millimetres, or else"
    " its units per metre (TUM: 5000)"
)


def negative_fy(source: str) -> Fails:
    """Return the expected end of a run whose camera has a negative fy."""
    return Fails(
        f"{source}; a negative fy, as published with ICL-NUIM, means that y points up; in images y points down, so give"
        " its absolute value, and mirror the y axis of the ground truth"
    )


def append(text: str) -> Damage:
    """Add lines to ``camera.yaml``."""
    return edit(YAML, lambda content: content + text.encode())


CASES = [
    Case("no depth scale", edit(YAML, replace_text("depth_scale", "#depth_scale")), NO_SCALE),
    Case("K.txt with a matrix, no depth scale", numbers(MATRIX), NO_SCALE),
    Case(
        "K.txt with six numbers, no depth scale",
        numbers(f"{FOCAL} {FOCAL} {CX} {CY} {WIDTH} {HEIGHT}\n"),
        NO_SCALE,
    ),
    Case("camera_info of ROS, no depth scale", write(YAML, ROS), NO_SCALE),
    Case(
        "K.txt with a matrix, in a folder of the TUM benchmark",
        all_of(numbers(MATRIX), rename("rgbd_dataset_freiburg3_walking_xyz")),
        Succeeds(),
    ),
    Case("negative fy", field("fy", "-64"), negative_fy("{seq}/camera.yaml: fy is -64")),
    Case(
        "K.txt with a negative fy",
        numbers(MATRIX.replace(f"0 {FOCAL}", f"0 -{FOCAL}")),
        negative_fy("{seq}/K.txt: fy is -64.0"),
    ),
    Case(
        "K.txt with a matrix, for 256x192 pixels",
        numbers(f"{2 * FOCAL} 0 127.5\n0 {2 * FOCAL} 95.5\n0 0 1\n"),
        Fails(
            "{seq}/K.txt: the principal point (127.5, 95.5) is far from the centre of the 128x96 images; give the"
            " camera of these images, not of a larger or smaller size"
        ),
    ),
    Case("no-break spaces", edit(YAML, lambda content: content.replace(b": ", b":\xc2\xa0")), Succeeds()),
    Case("settings of ORB-SLAM2", write(YAML, ORB_SLAM2), Succeeds()),
    Case("settings of ORB-SLAM3", write(YAML, ORB_SLAM3), Succeeds()),
    Case(
        "settings of ORB-SLAM2 without the image size",
        all_of(write("s.yaml", NO_SIZE), add_options("--camera", "{seq}/s.yaml")),
        Succeeds(),
    ),
    Case(
        "settings of ORB-SLAM2 without a focal length",
        write(YAML, ORB_SLAM2.replace("Camera.fy", "#")),
        Fails("{seq}/camera.yaml: is an incomplete camera file ('Camera.fy' is missing); export it again"),
    ),
    Case("camchain of Kalibr", write(YAML, KALIBR + STATED), Succeeds()),
    Case(
        "camchain of Kalibr, two cameras",
        write(YAML, KALIBR + KALIBR.replace("cam0", "cam1")),
        Fails("{seq}/camera.yaml: contains 2 cameras (cam0, cam1); keep only the colour camera"),
    ),
    Case(
        "camchain of Kalibr, another camera model",
        write(YAML, KALIBR.replace("pinhole", "omni")),
        Fails(
            "{seq}/camera.yaml: has the camera model omni, which is not supported; calibrate with pinhole-radtan or"
            " pinhole-equi"
        ),
    ),
    Case("camera_info of ROS", write(YAML, ROS + STATED), Succeeds()),
    Case(
        "camera_info of ROS, truncated",
        write(YAML, ROS[: ROS.index("  data")]),
        Fails("{seq}/camera.yaml: is an incomplete camera file ('data' is missing); export it again"),
    ),
    Case(
        "four distortion coefficients and their model",
        append("distortion: [0, 0, 0, 0]\ndistortion_model: plumb_bob\n"),
        Succeeds(),
    ),
    Case(
        "twelve distortion coefficients",
        append("distortion: [0, 0, 0, 0, 0, 0, 0, 0, 0.1, 0, 0, 0]\n"),
        Fails(
            "{seq}/camera.yaml: the camera's distortion has 12 coefficients, the model rational_polynomial has 8;"
            " give k1, k2, p1, p2, k3, k4, k5, k6, calibrated without further coefficients"
        ),
    ),
    Case(
        "unknown distortion model",
        append("distortion: [0.9]\ndistortion_model: fov\n"),
        Fails(
            "{seq}/camera.yaml: the distortion model fov is not supported; calibrate with one of plumb_bob,"
            " rational_polynomial, equidistant"
        ),
    ),
    Case(
        "fisheye of more than 170 degrees",
        all_of(field("fx", "20"), append("distortion_model: equidistant\n")),
        Fails(
            "{seq}/camera.yaml: the distortion (0.0, 0.0, 0.0, 0.0) cannot be inverted at the image corners; correct"
            " the camera's distortion (k1, k2, k3, k4), or crop the images to less than 170 degrees"
        ),
    ),
]
