"""Essential matrices against known motions and OpenCV; padding, the eight-point path, gradients."""

from __future__ import annotations

import cv2
import pytest
import torch
from helpers import camera_inputs
from helpers.gradients import check_gradients
from helpers.two_views import CAMERA, known_motion, two_views
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.features import sampson
from v3d_torch.features.essential import essential_ransac
from v3d_torch.geometry.se3 import hat


def true_matrix(T_ba: Tensor) -> Tensor:
    """Essential matrix of a motion, of unit norm."""
    t = T_ba[:3, 3]
    E = hat(torch.cat([torch.zeros_like(t), t]))[:3, :3] @ T_ba[:3, :3]
    return E / E.norm()


def difference(E: Tensor, expected: Tensor) -> float:
    """Largest difference, up to the sign."""
    return float(min((E - expected).abs().max(), (E + expected).abs().max()))


def test_convention_epipolar_constraint_has_image_b_on_the_left() -> None:
    a, b, T_ba = two_views()
    found = essential_ransac(a.uv, b.uv, CAMERA.K)
    assert found.found and found.inliers.all()
    assert difference(found.E, true_matrix(T_ba)) < 1e-6
    assert float(found.E.norm()) == pytest.approx(1)
    x_a, x_b = (
        torch.cat([CAMERA.normalise(view.uv), torch.ones(400, 1, dtype=torch.float64)], dim=1) for view in (a, b)
    )
    assert ((x_b @ found.E) * x_a).sum(dim=1).abs().max() < 1e-8


def test_matrix_is_as_accurate_as_that_of_opencv() -> None:
    a, b, T_ba = two_views(outliers=120, noise=0.5)
    found = essential_ransac(a.uv, b.uv, CAMERA.K, threshold=1.5)
    E, mask = cv2.findEssentialMat(a.uv.numpy(), b.uv.numpy(), CAMERA.K.numpy(), cv2.RANSAC, 0.999, 1.5)
    E = torch.from_numpy(E[:3])
    assert difference(found.E, true_matrix(T_ba)) <= difference(E / E.norm(), true_matrix(T_ba))
    assert found.inliers[:280].double().mean() > 0.97 and found.inliers[280:].double().mean() < 0.2
    assert int((found.inliers != torch.from_numpy(mask[:, 0] > 0)).sum()) < 40


def test_eight_points_give_the_same_matrix() -> None:
    """`torch.func.vmap` traces the function, so that torch finds the hypotheses."""
    a, b, T_ba = two_views(outliers=100, noise=0.5)
    pairs = torch.stack([a.uv, a.uv[:, [1, 0]]]), torch.stack([b.uv, b.uv[:, [1, 0]]])
    found = torch.func.vmap(lambda x, y: essential_ransac(x, y, CAMERA.K, threshold=1.5))(*pairs)
    expected = essential_ransac(a.uv, b.uv, CAMERA.K, threshold=1.5)
    assert difference(found.E[0], expected.E) < 0.02 and difference(found.E[0], true_matrix(T_ba)) < 0.05
    assert int((found.inliers[0] != expected.inliers).sum()) < 10


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_pairs_give_no_matrix(count: int) -> None:
    a, b, _ = two_views()
    valid = torch.arange(400) < count
    for found in (
        essential_ransac(a.uv[:count], b.uv[:count], CAMERA.K),
        essential_ransac(a.uv, b.uv, CAMERA.K, valid=valid),
    ):
        assert not found.found and not found.inliers.any() and not found.E.any()


def test_padding_has_no_effect() -> None:
    a, b, _ = two_views(outliers=60, noise=0.3)
    valid = torch.arange(400) % 4 > 0
    alone = essential_ransac(a.uv[valid], b.uv[valid], CAMERA.K)
    uv_a = torch.where(valid[:, None], a.uv, torch.nan)
    padded = essential_ransac(uv_a, b.uv, CAMERA.K, valid=valid)
    assert torch.equal(padded.inliers[valid], alone.inliers) and not padded.inliers[~valid].any()
    assert difference(padded.E, alone.E) < 1e-6


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_pairs_with_a_pixel_that_is_not_finite_are_padding(value: float) -> None:
    a, b, _ = two_views(outliers=60, noise=0.3)
    uv_a, uv_b = a.uv.clone(), b.uv.clone()
    uv_a[7, 0], uv_b[9] = value, -value
    finite = uv_a.isfinite().all(dim=-1) & uv_b.isfinite().all(dim=-1)
    for with_gradient in (False, True):
        K = CAMERA.K.clone().requires_grad_(with_gradient)
        found, expected = essential_ransac(uv_a, uv_b, K), essential_ransac(a.uv, b.uv, K, valid=finite)
        assert torch.equal(found.E, expected.E) and found.E.isfinite().all()
        assert torch.equal(found.inliers, expected.inliers) and not found.inliers[~finite].any()
        if with_gradient:
            assert torch.autograd.grad(found.E.sum(), K)[0].isfinite().all()


@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_problem_with_a_singular_camera_matrix_is_padding(value: float) -> None:
    a, b, _ = two_views(outliers=100)
    K = torch.stack([CAMERA.K, torch.full((3, 3), value, dtype=torch.float64)]).requires_grad_()
    found = essential_ransac(a.uv, b.uv, K)
    expected = essential_ransac(a.uv, b.uv, CAMERA.K)
    assert found.found.tolist() == [True, False]
    assert torch.equal(found.E[0], expected.E) and torch.equal(found.inliers[0], expected.inliers)
    assert not found.E[1].any() and not found.inliers[1].any()
    found.E.sum().backward()
    assert K.grad is not None and K.grad[0].isfinite().all() and not K.grad[1].any()


def test_negative_weight_is_an_error() -> None:
    a, b, _ = two_views()
    weights = torch.ones(400)
    weights[3] = -1
    with pytest.raises(InputError, match="weights has a value that is negative or NaN; give weights of at least 0"):
        essential_ransac(a.uv, b.uv, CAMERA.K, weights)


def test_gradients_equal_finite_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampson, "_TOLERANCE", 1e-15)
    monkeypatch.setattr(sampson, "_ITERATIONS", 60)
    inputs = camera_inputs.two_views(2, 25, torch.float64)
    inputs["valid"] = torch.arange(25).expand(2, 25) % 6 > 0
    weights = 0.5 + torch.rand(2, 25, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def matrix(uv_a: Tensor, uv_b: Tensor, K: Tensor, weights: Tensor) -> Tensor:
        return essential_ransac(uv_a, uv_b, K, weights, inputs["valid"], threshold=5.0).E

    assert check_gradients(matrix, inputs["uv_a"], inputs["uv_b"], inputs["K"], weights)


def test_matrix_of_a_camera_that_only_turns_is_one_that_explains_the_pairs() -> None:
    """Any translation explains the pairs, so that five of them do not determine a matrix."""
    T_ba = known_motion()
    T_ba[:3, 3] = 0
    a, _, _ = two_views()
    points = CAMERA.back_project(a.uv, a.depth) @ T_ba[:3, :3].T
    found = essential_ransac(a.uv, CAMERA.project(points), CAMERA.K)
    assert bool(found.found) and found.E.isfinite().all() and found.inliers.double().mean() > 0.9


@pytest.mark.parametrize("count", [0, 1, 5, 7])
def test_too_few_pairs_of_a_mapped_batch_give_no_matrix(count: int) -> None:
    inputs = camera_inputs.two_views(2, count, torch.float64)
    found = torch.func.vmap(essential_ransac)(inputs["uv_a"], inputs["uv_b"], inputs["K"])
    assert found.found.tolist() == [False, False] and not found.inliers.any() and not found.E.any()
