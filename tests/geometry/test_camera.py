"""Pinhole camera: conventions, agreement with OpenCV, validation."""

from __future__ import annotations

import math
from dataclasses import astuple, replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import BackProjector, PinholeCamera

FR1 = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
FR3 = PinholeCamera(535.4, 539.2, 320.1, 247.6)


def test_convention_axes() -> None:
    """x right, y down, z forward: a point to the right of and below the optical axis has larger u and v."""
    centre = FR3.project(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))
    assert centre.tolist() == pytest.approx([320.1, 247.6])
    u, v = FR3.project(torch.tensor([0.5, 0.25, 2.0], dtype=torch.float64)).tolist()
    assert (u, v) == pytest.approx((320.1 + 535.4 * 0.25, 247.6 + 539.2 * 0.125))


def test_convention_pixel_centres_are_integers() -> None:
    """The ray of pixel (row 10, column 20) passes through (u, v) = (20, 10)."""
    assert FR3.project(FR3.rays[10, 20].double()).tolist() == pytest.approx([20.0, 10.0], abs=1e-3)


@given(u=st.floats(0, 639), v=st.floats(0, 479), z=st.floats(0.1, 10))
def test_project_inverts_back_project(u: float, v: float, z: float) -> None:
    uv = torch.tensor([u, v], dtype=torch.float64)
    assert torch.allclose(FR3.project(FR3.back_project(uv, torch.tensor(z, dtype=torch.float64))), uv, atol=1e-9)


def test_undistort_inverts_opencv_projection() -> None:
    """Accurate to 1e-5 pixels over the whole image, even with the strong lens distortion of fr1."""
    v, u = np.mgrid[20:460:20.0, 20:620:20.0]
    undistorted = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = np.concatenate([(undistorted - [FR1.cx, FR1.cy]) / [FR1.fx, FR1.fy], np.ones((len(u.ravel()), 1))], axis=1)
    distorted = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), FR1.K.numpy(), np.array(FR1.distortion))[0][:, 0]
    assert np.abs(FR1.undistort(torch.from_numpy(distorted)).numpy() - undistorted).max() < 1e-5


def test_distort_equals_opencv_projection() -> None:
    undistorted = torch.rand(200, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 480
    rays = FR1.back_project(undistorted, torch.ones(200, dtype=torch.float64)).numpy()
    distorted = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), FR1.K.numpy(), np.array(FR1.distortion))[0][:, 0]
    torch.testing.assert_close(FR1.distort(undistorted), torch.from_numpy(distorted), rtol=0, atol=1e-9)


def test_undistort_of_no_pixels_is_empty() -> None:
    assert FR1.undistort(torch.zeros(0, 2)).shape == (0, 2)


def test_distort_inverts_undistort() -> None:
    uv = torch.rand(500, 2, dtype=torch.float64) * torch.tensor([600.0, 440.0]) + 20
    assert torch.allclose(FR1.distort(FR1.undistort(uv)), uv, atol=1e-5)


def test_change_of_the_camera_matrix_does_not_change_the_camera() -> None:
    camera = replace(FR3)
    K = camera.K
    K[:2] *= 0.5
    assert torch.equal(camera.K, FR3.K)


@pytest.mark.parametrize("camera", [FR1, FR3])
def test_back_projected_image_equals_back_projected_pixels(camera: PinholeCamera) -> None:
    depth = torch.rand(2, 1, 480, 640) * 4
    depth[:, :, 100:200, 100:200] = 0
    points = BackProjector(camera)(depth)
    assert points.shape == (2, 480, 640, 3)
    assert (points[:, 100:200, 100:200] == 0).all()
    pixel = camera.undistort(torch.tensor([[400.0, 300.0]]))
    expected = camera.back_project(pixel[0], depth[1, 0, 300, 400].double())
    assert torch.allclose(points[1, 300, 400].double(), expected, atol=1e-5)


def test_back_projection_gradcheck() -> None:
    camera = PinholeCamera(5.0, 5.0, 3.5, 2.5, width=8, height=6)
    depth = (torch.rand(1, 1, 6, 8, dtype=torch.float64) + 0.5).requires_grad_()
    assert torch.autograd.gradcheck(BackProjector(camera), (depth,))


@pytest.mark.parametrize("camera", [FR1, FR3], ids=["distorted", "undistorted"])
def test_camera_that_is_first_used_in_inference_mode_has_gradients(camera: PinholeCamera) -> None:
    camera = replace(camera)  # without cached tensors
    with torch.inference_mode():
        camera.project_to_image(torch.ones(1, 3, dtype=torch.float64), 0.1)
        camera.normalise(camera.K[:2, :2])
    depth = torch.ones(1, 1, camera.height, camera.width, requires_grad=True)
    BackProjector(camera)(depth).sum().backward()
    assert depth.grad is not None
    points = torch.rand(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    uv, inside = camera.project_to_image(points + 1, 0.1)
    (uv[inside].sum() + camera.normalise(camera.distort(points[:, :2] * 100)).sum()).backward()
    assert points.grad is not None
    assert not any(value.is_inference() for value in vars(camera).values() if isinstance(value, torch.Tensor))


@pytest.mark.parametrize("offset", [0.02, -0.02])
def test_offset_is_added_to_the_measured_inverse_depth(offset: float) -> None:
    depth = torch.tensor([0.5, 2.0, 8.0, 40.0], dtype=torch.float64)
    corrected = replace(FR3, inverse_depth_offset=offset).correct_depth(depth)
    torch.testing.assert_close(1 / corrected, 1 / depth + offset)


def test_missing_depth_and_depth_that_an_offset_makes_infinite_are_missing() -> None:
    depth = torch.tensor([0.0, 31.0, 32.0, 33.0])
    assert (replace(FR3, inverse_depth_offset=-1 / 32).correct_depth(depth) > 0).tolist() == [False, True, False, False]
    assert replace(FR3, inverse_depth_offset=1 / 32).correct_depth(depth)[0] == 0


def test_image_ends_half_a_pixel_beyond_its_outermost_pixel_centres() -> None:
    inside = torch.tensor([[-0.4, -0.4], [639.4, 479.4]], dtype=torch.float64)
    outside = torch.tensor([[-0.6, 9], [9, -0.6], [639.6, 9], [9, 479.6]], dtype=torch.float64)
    uv = torch.cat([inside, outside])
    pixels, in_image = FR3.project_to_image(FR3.back_project(uv, torch.full((6,), 2.0, dtype=torch.float64)), 0.1)
    assert in_image.tolist() == [True, True, False, False, False, False]
    torch.testing.assert_close(pixels[:2], inside)


def test_point_at_the_minimum_depth_is_not_in_the_image() -> None:
    points = torch.tensor([[0, 0, 0.3], [0, 0, 0.3 + 1e-9], [0, 0, 0.2], [0, 0, -1]], dtype=torch.float64)
    assert FR3.project_to_image(points, 0.3)[1].tolist() == [False, True, False, False]


def test_camera_accepts_numpy_and_torch_numbers() -> None:
    K = np.array([[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1]])
    distortion = np.array([[0.2624, -0.9531, -0.0054, 0.0026, 1.1633]])  # as cv2.calibrateCamera returns it
    camera = PinholeCamera(K[0, 0], torch.tensor(516.5).double(), K[0, 2], K[1, 2], np.int64(640), 480.0, distortion)
    assert camera == FR1 and hash(camera) == hash(FR1) and torch.equal(camera.rays, FR1.rays)
    rolling = replace(camera, readout=np.float32(0.03125))
    assert camera.readout is None and rolling.readout == 0.03125
    assert all(type(value) in (int, float, tuple, str) for value in astuple(replace(rolling, depth_scale=1)))
    assert PinholeCamera(535.4, 539.2, 320.1, 247.6, distortion=(0.1, 0.2, 0, 0)).distortion == (0.1, 0.2, 0, 0, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0}, "fx is 0; give a finite number above 0"),
        ({"fy": -480.0}, "fy is -480.0; give a finite number above 0 .a negative fy, .* means that y points up; .*"),
        ({"fx": np.eye(3)}, "fx is array"),
        ({"cx": math.nan}, "cx is nan; give a finite number$"),
        ({"cy": None}, "cy is None; give"),
        ({"width": 0}, "width is 0; give"),
        ({"height": 479.5}, "height is 479.5; give whole pixels"),
        ({"depth_scale": 0}, "depth_scale is 0; give"),
        ({"distortion": "barrel"}, "distortion is 'barrel'; give the numbers k1, k2, p1, p2, k3"),
        ({"distortion": None}, "distortion is None; give"),
        ({"readout": 33.0}, r"readout is 33.0; give seconds, at most 0.05"),
        ({"readout": "rolling"}, "readout is 'rolling'; give seconds"),
    ],
)
def test_invalid_camera_is_rejected(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=f"^the camera's {message}"):
        PinholeCamera(**{"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0} | change)


def test_error_of_the_size_of_an_image_names_depth_and_camera() -> None:
    project = BackProjector(PinholeCamera(50.0, 50.0, 15.5, 11.5, width=32, height=24))
    with pytest.raises(ShapeError, match=r"^depth has the shape \(1, 1, 12, 16\); .* of shape \(B, 1, 24, 32\)$"):
        project(torch.ones(1, 1, 12, 16))
