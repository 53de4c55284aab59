"""Distortion models: agreement with OpenCV, inverses, gradients."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.distortion import COEFFICIENTS, distort, undistort_pixels

BROWN = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
RATIONAL = PinholeCamera(  # of an Azure Kinect
    605.1, 604.9, 637.9, 366.9, 1280, 720, (0.4548, -2.5286, 0.0006, -0.0003, 1.4623, 0.3332, -2.3455, 1.3887)
)
FISHEYE = PinholeCamera(
    285.9, 286.1, 321.7, 238.1, 640, 480, (-0.0057, 0.0119, -0.0064, 0.0009), distortion_model="equidistant"
)
CAMERAS = [BROWN, RATIONAL, FISHEYE]
IDS = [camera.distortion_model for camera in CAMERAS]


def pixels(camera: PinholeCamera, count: int = 500) -> torch.Tensor:
    """Random pixels of the image, without the outermost tenth."""
    uniform = torch.rand(count, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (0.1 + 0.8 * uniform) * torch.tensor([camera.width - 1, camera.height - 1])


def opencv_distort(camera: PinholeCamera, undistorted: torch.Tensor) -> np.ndarray:
    """Distort undistorted pixels with OpenCV."""
    xy = camera.normalise(undistorted).numpy()
    K, D = camera.K.numpy(), np.array(camera.distortion)
    if camera.distortion_model == "equidistant":
        return cv2.fisheye.distortPoints(xy[:, None], K, D)[:, 0]
    points = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0]


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_distort_equals_opencv(camera: PinholeCamera) -> None:
    undistorted = camera.undistort(pixels(camera))
    np.testing.assert_allclose(camera.distort(undistorted), opencv_distort(camera, undistorted), atol=1e-9)


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_undistort_inverts_opencv(camera: PinholeCamera) -> None:
    expected = camera.undistort(pixels(camera))
    distorted = torch.from_numpy(opencv_distort(camera, expected))
    assert (camera.undistort(distorted) - expected).abs().max() < 1e-4


def test_undistort_equals_opencv_undistort_points() -> None:
    uv = pixels(RATIONAL)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    K, D = RATIONAL.K.numpy(), np.array(RATIONAL.distortion)
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # its name with criteria in OpenCV 4
    expected = undistort(uv.numpy()[:, None], K, D, None, None, K, criteria)[:, 0]
    np.testing.assert_allclose(RATIONAL.undistort(uv), expected, atol=1e-4)
    uv = pixels(FISHEYE)
    K, D = FISHEYE.K.numpy(), np.array(FISHEYE.distortion)
    expected = cv2.fisheye.undistortPoints(uv.numpy()[:, None], K, D, None, None, K)[:, 0]
    np.testing.assert_allclose(FISHEYE.undistort(uv), expected, atol=1e-4)


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_distort_inverts_undistort_in_the_whole_image(camera: PinholeCamera) -> None:
    v, u = torch.meshgrid(torch.arange(0, camera.height, 7), torch.arange(0, camera.width, 7), indexing="ij")
    uv = torch.stack([u, v], dim=-1).reshape(-1, 2).to(torch.float64)
    assert (camera.distort(camera.undistort(uv)) - uv).abs().max() < 1e-3


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_distort_gradcheck(camera: PinholeCamera) -> None:
    xy = torch.tensor([[0.3, -0.2], [0.0, 0.5], [-0.7, 0.1]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda xy: distort(xy, camera.distortion_model, camera.distortion), (xy,))


def test_gradient_on_the_optical_axis_is_the_identity() -> None:
    xy = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    for camera in CAMERAS:
        jacobian = torch.autograd.functional.jacobian(
            lambda xy, camera=camera: distort(xy, camera.distortion_model, camera.distortion), xy
        )
        torch.testing.assert_close(jacobian[0, :, 0], torch.eye(2, dtype=torch.float64))


def test_points_on_the_optical_axis_of_a_fisheye_project_to_the_principal_point() -> None:
    centre = torch.tensor([[0.0, 0.0, 1.5]], dtype=torch.float64)
    assert FISHEYE.project_to_image(centre, 0.1)[0].tolist() == [pytest.approx([FISHEYE.cx, FISHEYE.cy])]


def test_fisheye_without_coefficients_is_not_a_pinhole() -> None:
    camera = PinholeCamera(300, 300, 319.5, 239.5, distortion=(), distortion_model="equidistant")
    assert camera.is_distorted and camera.distortion == (0, 0, 0, 0)
    angle = torch.atan(camera.rays[239, :, 0].double())  # the radius is the angle times the focal length
    torch.testing.assert_close(angle * 300 + 319.5, torch.arange(640, dtype=torch.float64), atol=1e-3, rtol=0)


def test_undistorted_bounds_contain_all_undistorted_pixels() -> None:
    corners = torch.tensor([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]])
    u_min, v_min, u_max, v_max = FISHEYE.undistorted_bounds
    u, v = FISHEYE.undistort(corners).unbind(dim=1)
    assert u_min < u.min() < -500 and v_min < v.min() and u.max() < u_max and v.max() < v_max
    u_min, v_min, u_max, v_max = BROWN.undistorted_bounds
    u, v = BROWN.undistort(corners).unbind(dim=1)
    assert u_min < u.min() and v_min < v.min() and u.max() < u_max and v.max() < v_max
    assert PinholeCamera(300.0, 300.0, 319.5, 239.5, 640, 480).undistorted_bounds == (0, 0, 640, 480)


def test_undistorted_bounds_contain_the_image_of_a_lens_that_shrinks_it() -> None:
    camera = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    assert camera.undistort(torch.zeros(1, 2)).min() > 4
    assert camera.undistorted_bounds == (0, 0, 640, 480)


@pytest.mark.parametrize(
    ("distortion", "model", "completed", "completed_model"),
    [
        ((), "plumb_bob", (0, 0, 0, 0, 0), "plumb_bob"),
        (np.array([[0.1, 0.2, 0.01, 0.02]]), "plumb_bob", (0.1, 0.2, 0.01, 0.02, 0), "plumb_bob"),
        (np.arange(1, 9) / 10, "plumb_bob", tuple(np.arange(1, 9) / 10), "rational_polynomial"),
        ([0.1, 0, 0, 0, 0, 0, 0, 0], "rational_polynomial", (0.1, 0, 0, 0, 0), "plumb_bob"),
        ([*np.arange(1, 9) / 10, 0, 0, 0, 0], "plumb_bob", tuple(np.arange(1, 9) / 10), "rational_polynomial"),
        ([0.1, 0.2], "equidistant", (0.1, 0.2, 0, 0), "equidistant"),
    ],
)
def test_coefficients_of_opencv_are_completed(
    distortion: object, model: str, completed: tuple[float, ...], completed_model: str
) -> None:
    camera = PinholeCamera(500, 500, 320, 240, distortion=distortion, distortion_model=model)
    assert camera.distortion == completed and camera.distortion_model == completed_model
    assert len(camera.distortion) == len(COEFFICIENTS[camera.distortion_model])
    assert hash(camera) == hash(PinholeCamera(500, 500, 320, 240, distortion=completed, distortion_model=model))


@pytest.mark.parametrize(
    ("distortion", "model", "message"),
    [
        (
            range(1, 13),
            "plumb_bob",
            "has 12 coefficients, the model rational_polynomial has 8; give k1, k2, p1, p2, k3",
        ),
        (range(1, 6), "equidistant", "has 5 coefficients, the model equidistant has 4; give k1, k2, k3, k4"),
        ((0.1,), "fov", "distortion_model is 'fov'; give one of plumb_bob, rational_polynomial, equidistant"),
        ((float("nan"),), "equidistant", "give the numbers k1, k2, k3, k4"),
    ],
)
def test_distortion_that_no_model_has_is_rejected(distortion: object, model: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PinholeCamera(500, 500, 320, 240, distortion=distortion, distortion_model=model)


def test_undistort_pixels_does_not_change_its_argument() -> None:
    uv = pixels(FISHEYE)
    before = uv.clone()
    undistort_pixels(uv, FISHEYE.K, FISHEYE.distortion_model, FISHEYE.distortion)
    assert torch.equal(uv, before)
