"""Pose refinement against SciPy and gtsam; outliers, degenerate measurements, padding; gradients, training."""

from __future__ import annotations

import doctest
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import torch
from helpers import camera_inputs
from helpers.gradients import check_gradients
from helpers.measured_landmarks import CAMERA, INVERSE_DEPTH_SIGMA, measure_landmarks
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.optim.pose_refinement import PoseRefinement, refine_pose, refine_pose_unchecked
from v3d_torch.optim.reprojection import Measurements, reprojection_jacobian, reprojection_residuals
from v3d_torch.optim.robust_losses import huber


def refine(T_cw: Tensor, points: Tensor, measured: Measurements) -> PoseRefinement:
    return refine_pose(T_cw, points, K=CAMERA.K, **vars(measured))


def perturb(T_cw: Tensor, scale: float = 0.03) -> Tensor:
    return se3_exp(scale * torch.tensor([1.0, -1.0, 0.5, 1.0, 0.7, -1.0], dtype=torch.float64)) @ T_cw


def test_refined_pose_equals_the_optimum_of_scipy() -> None:
    T_cw, points, measured, _ = measure_landmarks(300, outliers=0.2)
    refined = refine(perturb(T_cw), points, measured)
    inliers = refined.inliers

    def residuals(xi: np.ndarray) -> np.ndarray:
        T = se3_exp(torch.from_numpy(xi)) @ T_cw
        return reprojection_residuals(points @ T[:3, :3].T + T[:3, 3], measured, CAMERA.K)[inliers].flatten().numpy()

    best = scipy.optimize.least_squares(residuals, np.zeros(6), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    expected = se3_exp(torch.from_numpy(best.x)) @ T_cw
    # Far below the standard deviation of the pose.
    assert se3_log(refined.T_cw @ invert(expected)).abs().max() < 1e-5
    torch.testing.assert_close(float(refined.chi2[inliers].sum()), 2 * best.cost, rtol=1e-4, atol=0)
    torch.testing.assert_close(refined.information, torch.from_numpy(best.jac.T @ best.jac), rtol=0.05, atol=2e3)


@pytest.mark.parametrize("rounds", [1, 2, 4])
def test_refinement_without_checks_gives_the_same_result(rounds: int) -> None:
    T_cw, points, measured, _ = measure_landmarks(300, outliers=0.2)
    expected = refine_pose(perturb(T_cw), points, K=CAMERA.K, **vars(measured), rounds=rounds)
    found = refine_pose_unchecked(perturb(T_cw), points, measured, CAMERA.K, rounds=rounds)
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def test_refined_pose_equals_the_optimum_of_gtsam() -> None:
    gtsam = pytest.importorskip("gtsam")  # not on Windows
    T_cw, points, measured, _ = measure_landmarks(200)
    refined = refine(perturb(T_cw), points, measured)
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    # A stereo camera with a baseline of one unit of inverse depth measures (u, u - w, v) for (u, v, w = 1/z).
    stereo = gtsam.Cal3_S2Stereo(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy, 1 / CAMERA.fx)
    mono = gtsam.Cal3_S2(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy)
    for k in torch.nonzero(refined.inliers)[:, 0].tolist():
        (u, v), w, sigma = measured.uv[k].tolist(), float(measured.inverse_depth[k]), float(measured.pixel_sigma[k])
        initial.insert(k + 1, gtsam.Point3(points[k].numpy()))
        graph.add(gtsam.NonlinearEqualityPoint3(k + 1, gtsam.Point3(points[k].numpy())))
        if w > 0:
            A = np.array([[1.0, 0, 0], [1, 0, -1], [0, 1, 0]])
            noise = gtsam.noiseModel.Gaussian.Covariance(
                A @ np.diag([sigma**2, sigma**2, INVERSE_DEPTH_SIGMA**2]) @ A.T
            )
            graph.add(gtsam.GenericStereoFactor3D(gtsam.StereoPoint2(u, u - w, v), noise, 0, k + 1, stereo))
        else:
            noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
            graph.add(gtsam.GenericProjectionFactorCal3_S2(gtsam.Point2(u, v), noise, 0, k + 1, mono))
    initial.insert(0, gtsam.Pose3(invert(T_cw).numpy()))
    best = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize().atPose3(0).matrix()
    assert se3_log(refined.T_cw @ torch.from_numpy(best)).abs().max() < 1e-5


@pytest.mark.parametrize("outliers", [0.0, 0.2, 0.4])
def test_outliers_are_rejected_and_do_not_bias_the_pose(outliers: float) -> None:
    T_cw, points, measured, correct = measure_landmarks(500, outliers)
    refined = refine(perturb(T_cw), points, measured)
    accepted = float((refined.inliers & correct).sum() / correct.sum())
    assert abs(accepted - 0.95) < 0.03  # the thresholds are 95 % quantiles
    assert (refined.inliers & ~correct).sum() <= 0.02 * len(correct)
    error = se3_log(refined.T_cw @ invert(T_cw))
    # 28 is the 99.99 % quantile of the chi-square distribution with 6 degrees of freedom.
    assert error @ refined.information @ error < 28


def test_one_measurement_with_depth_determines_the_distance() -> None:
    points = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64)
    measured = Measurements(
        uv=torch.tensor([[CAMERA.cx, CAMERA.cy]], dtype=torch.float64),
        inverse_depth=torch.tensor([1 / 1.9], dtype=torch.float64),
        pixel_sigma=torch.ones(1, dtype=torch.float64),
        inverse_depth_sigma=INVERSE_DEPTH_SIGMA,
    )
    refined = refine(torch.eye(4, dtype=torch.float64), points, measured)
    in_camera = refined.T_cw[:3, :3] @ points[0] + refined.T_cw[:3, 3]
    assert abs(float(in_camera[2]) - 1.9) < 1e-3
    assert refined.inliers.tolist() == [True]


def test_pose_without_measurements_is_the_prediction() -> None:
    T_cw, points, measured, _ = measure_landmarks(4)
    none = Measurements(
        uv=measured.uv[:0],
        inverse_depth=measured.inverse_depth[:0],
        pixel_sigma=measured.pixel_sigma[:0],
        inverse_depth_sigma=INVERSE_DEPTH_SIGMA,
    )
    refined = refine(T_cw, points[:0], none)
    torch.testing.assert_close(refined.T_cw, T_cw, rtol=0, atol=1e-14)
    assert refined.inliers.shape == (0,)


def test_points_behind_the_camera_are_outliers() -> None:
    T_cw, points, measured, _ = measure_landmarks(100)
    in_camera = points @ T_cw[:3, :3].T + T_cw[:3, 3]
    in_camera[7] = -in_camera[7]  # projects to the same pixel
    measured.inverse_depth[7] = 0.0
    T_wc = invert(T_cw)
    refined = refine(T_cw, in_camera @ T_wc[:3, :3].T + T_wc[:3, 3], measured)
    assert not refined.inliers[7]
    assert torch.isinf(refined.chi2[7])
    assert refined.inliers.sum() > 85
    assert se3_log(refined.T_cw @ T_wc).abs().max() < 0.005


@pytest.mark.parametrize("with_gradient", [False, True], ids=["kernel", "torch"])
def test_measurements_that_are_not_finite_are_outliers(with_gradient: bool) -> None:
    T_cw, points, measured, _ = measure_landmarks(100)
    uv, valid = measured.uv.clone(), torch.ones(100, dtype=torch.bool)
    points[7], points[8, 2], points[9, 0], uv[10, 1] = torch.nan, torch.inf, -torch.inf, torch.nan
    valid[7:11] = False
    depths = measured.inverse_depth, measured.pixel_sigma, measured.inverse_depth_sigma
    inputs = perturb(T_cw), points.requires_grad_(with_gradient), uv, CAMERA.K, *depths
    found, expected = refine_pose(*inputs), refine_pose(*inputs, valid=valid)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)
    assert not found.inliers[7:11].any() and found.inliers.sum() > 85 and found.chi2[7:11].isinf().all()
    assert se3_log(found.T_cw @ invert(T_cw)).abs().max() < 0.005
    if with_gradient:
        found.T_cw.sum().backward()
        assert points.grad is not None and points.grad.isfinite().all()


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("with_gradient", [False, True], ids=["kernel", "torch"])
def test_inverse_depth_that_is_not_finite_counts_as_not_measured(value: float, with_gradient: bool) -> None:
    T_cw, points, measured, _ = measure_landmarks(100)
    inverse_depth, not_measured = measured.inverse_depth.clone(), measured.inverse_depth.clone()
    inverse_depth[7], not_measured[7] = value, 0.0
    depths = inverse_depth.requires_grad_(with_gradient), not_measured.requires_grad_(with_gradient)
    given, sigmas = (points.requires_grad_(with_gradient), measured.uv, CAMERA.K), (measured.pixel_sigma, 0.0025)
    found, expected = (refine_pose(perturb(T_cw), *given, depth, *sigmas) for depth in depths)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)
    assert se3_log(found.T_cw @ invert(T_cw)).abs().max() < 0.005
    if with_gradient:
        by_found = torch.autograd.grad(found.T_cw.sum(), (points, inverse_depth))
        by_expected = torch.autograd.grad(expected.T_cw.sum(), (points, not_measured))
        assert torch.equal(by_found[0], by_expected[0]) and torch.equal(by_found[1], by_expected[1])


def test_refinement_is_deterministic() -> None:
    T_cw, points, measured, _ = measure_landmarks(500, 0.3)
    first, second = (refine(perturb(T_cw), points, measured) for _ in range(2))
    assert torch.equal(first.T_cw, second.T_cw)
    assert torch.equal(first.inliers, second.inliers)


# ---------------------------------------------------------------- batches, padding, weights


@settings(max_examples=20)
@given(st.lists(st.booleans(), min_size=60, max_size=60), st.integers(1, 4))
def test_padding_between_measurements_has_no_effect(present: list[bool], rounds: int) -> None:
    inputs, valid = camera_inputs.view(1, 60, torch.float64), torch.tensor([present])
    alone = {name: each[:, valid[0]] if each.shape[1:2] == (60,) else each for name, each in inputs.items()}
    padded = {
        name: torch.where(valid.reshape(1, 60, *[1] * (each.ndim - 2)), each, torch.nan)
        if each.shape[1:2] == (60,) and each.is_floating_point()
        else each
        for name, each in inputs.items()
    }
    found = refine_pose(**padded | {"valid": valid}, rounds=rounds)
    expected = refine_pose(**alone | {"valid": None}, rounds=rounds)
    torch.testing.assert_close(found.T_cw, expected.T_cw, rtol=0, atol=1e-9)
    assert torch.equal(found.inliers[valid], expected.inliers[0]) and not found.inliers[~valid].any()
    torch.testing.assert_close(found.chi2[valid], expected.chi2[0], rtol=1e-6, atol=1e-9)


def test_convention_a_weight_counts_a_measurement_so_many_times() -> None:
    inputs = camera_inputs.view(2, 40, torch.float64) | {"weights": None, "valid": None}
    weights = torch.arange(40).expand(2, 40) % 3
    repeats = torch.arange(40).repeat_interleave(weights[0])
    repeated = {
        name: each[:, repeats] if each is not None and each.shape[1:2] == (40,) else each
        for name, each in inputs.items()
    }
    found = refine_pose(**inputs | {"weights": weights}, iterations=20, tolerance=1e-12)
    expected = refine_pose(**repeated, iterations=20, tolerance=1e-12)
    torch.testing.assert_close(found.T_cw, expected.T_cw, rtol=0, atol=1e-8)
    torch.testing.assert_close(found.information, expected.information, rtol=1e-4, atol=1.0)


@pytest.mark.parametrize("name", ["inverse_depth", "weights", "valid"])
@pytest.mark.parametrize("size", [1, 5, 9])
def test_wrong_number_of_values_is_rejected(name: str, size: int) -> None:
    points = torch.ones(8, 3)
    wrong = torch.ones(size, dtype=torch.bool if name == "valid" else torch.float64)
    with pytest.raises(ShapeError):
        refine_pose(torch.eye(4), points, points[:, :2], CAMERA.K, **{name: wrong})


@pytest.mark.parametrize("name", ["pixel_sigma", "inverse_depth_sigma"])
@pytest.mark.parametrize("shape", [(5,), (8, 1), (8, 8, 1)])
def test_standard_deviations_that_are_not_one_for_each_measurement_are_rejected(name: str, shape: list[int]) -> None:
    points = torch.ones(8, 3)
    with pytest.raises(ShapeError):
        refine_pose(torch.eye(4), points, points[:, :2], CAMERA.K, **{name: torch.ones(shape)})


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
def test_tensor_with_one_standard_deviation_counts_as_a_number(shape: list[int]) -> None:
    start, points, measured, _ = measure_landmarks(8)
    given = vars(measured) | {"pixel_sigma": 2.0}
    expected = refine_pose(start, points, K=CAMERA.K, **given)
    given["pixel_sigma"] = torch.full(shape, 2.0)
    found = refine_pose(start, points, K=CAMERA.K, **given)
    torch.testing.assert_close(found.T_cw.reshape(4, 4), expected.T_cw, rtol=0, atol=1e-12)


@pytest.mark.parametrize("value", [-1.0, torch.nan])
def test_weight_that_is_negative_or_nan_is_an_error(value: float) -> None:
    _, points, measured, _ = measure_landmarks(8)
    weights, valid = torch.ones(8), torch.ones(8, dtype=torch.bool)
    weights[3] = value
    with pytest.raises(InputError, match="weights has a value that is negative or NaN; give weights of at least 0"):
        refine_pose(torch.eye(4), points, K=CAMERA.K, **vars(measured), weights=weights)
    valid[3] = False
    refine_pose(torch.eye(4), points, K=CAMERA.K, **vars(measured), weights=weights, valid=valid)  # padding


def test_leading_dimensions_are_those_of_the_batch() -> None:
    """A single camera matrix, and landmarks that all cameras share, are broadcast."""
    T_cw, points, measured, _ = measure_landmarks(80)
    starts = torch.stack([perturb(T_cw, scale) for scale in (0.01, 0.02, 0.03, -0.01, -0.02, 0.0)]).reshape(2, 3, 4, 4)
    refined = refine_pose(starts, points, K=CAMERA.K, **vars(measured))
    assert refined.T_cw.shape == (2, 3, 4, 4) and refined.inliers.shape == (2, 3, 80)
    alone = refine(starts[1, 2], points, measured)
    torch.testing.assert_close(refined.T_cw[1, 2], alone.T_cw, rtol=0, atol=1e-9)
    torch.testing.assert_close(refined.T_cw, alone.T_cw.expand(2, 3, 4, 4), rtol=0, atol=1e-4)


def test_float32_is_computed_in_float64() -> None:
    inputs = camera_inputs.view(2, 60, torch.float64)
    single = {name: each.float() if each.is_floating_point() else each for name, each in inputs.items()}
    found, expected = refine_pose(**single), refine_pose(**inputs)
    assert found.T_cw.dtype == found.chi2.dtype == found.information.dtype == torch.float32
    torch.testing.assert_close(found.T_cw.double(), expected.T_cw, rtol=0, atol=1e-6)


# ---------------------------------------------------------------- gradients

CONVERGED = {"iterations": 60, "tolerance": 1e-15}


def clean_view() -> dict[str, Tensor]:
    """Two cameras with 20 landmarks each, whose measurements are all inliers."""
    inputs = camera_inputs.view(2, 20, torch.float64)
    return inputs | {"valid": torch.arange(20).expand(2, 20) % 5 > 0}


@pytest.mark.parametrize("rounds", [1, 4], ids=["robust", "inliers"])
def test_gradients_equal_finite_differences(rounds: int) -> None:
    """With respect to landmarks, pixels, intrinsics, depths, standard deviations, and weights."""
    inputs = clean_view()
    if rounds == 1:
        inputs["uv"][:, ::4] += 6.0  # where Huber's loss is linear
    measured = inputs["inverse_depth"] > 0

    def pose(points: Tensor, uv: Tensor, K: Tensor, depth: Tensor, sigmas: Tensor, weights: Tensor) -> Tensor:
        inverse_depth = torch.where(measured, inputs["inverse_depth"] / (1 + depth), 0.0)
        given = {"points": points, "uv": uv, "K": K, "inverse_depth": inverse_depth, "weights": weights}
        pixel_sigma, inverse_depth_sigma = sigmas.exp()
        noise = {"pixel_sigma": pixel_sigma, "inverse_depth_sigma": 0.02 * inverse_depth_sigma}
        return refine_pose(**inputs | given, **noise, rounds=rounds, **CONVERGED).T_cw

    scales = torch.zeros_like(inputs["inverse_depth"]), torch.zeros(2, dtype=torch.float64)
    assert check_gradients(pose, inputs["points"], inputs["uv"], inputs["K"], *scales, inputs["weights"])


def test_gradients_equal_those_of_unrolled_iterations() -> None:
    inputs = clean_view()
    inputs["uv"][:, ::4] += 6.0
    weights = inputs["weights"].clone().requires_grad_()
    refined = refine_pose(**inputs | {"weights": weights}, rounds=1, **CONVERGED)
    projection = torch.randn(refined.T_cw.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (implicit,) = torch.autograd.grad((projection * refined.T_cw).sum(), weights)

    T_cw, influence = inputs["T_cw"], torch.where(inputs["valid"], weights, 0.0)
    measured = Measurements(
        uv=inputs["uv"], inverse_depth=inputs["inverse_depth"], pixel_sigma=1.0, inverse_depth_sigma=0.025
    )
    for _ in range(60):  # Gauss-Newton with autograd through every step
        in_camera = inputs["points"] @ T_cw[..., :3, :3].mT + T_cw[..., None, :3, 3]
        r = reprojection_residuals(in_camera, measured, inputs["K"])
        J = reprojection_jacobian(in_camera, measured, inputs["K"])
        _, robust = huber(r.square().sum(dim=-1), measured.chi2_threshold)
        weighted = J.mT * (robust * influence)[..., None, None]
        H, g = (weighted @ J).sum(dim=1), (weighted @ r[..., None]).sum(dim=1)[..., 0]
        T_cw = se3_exp(-torch.linalg.solve(H, g)) @ T_cw
    torch.testing.assert_close(refined.T_cw, T_cw, rtol=0, atol=1e-7)
    (unrolled,) = torch.autograd.grad((projection * T_cw).sum(), weights)
    torch.testing.assert_close(implicit, unrolled, rtol=1e-4, atol=1e-9)


def test_prediction_and_outliers_have_no_gradient() -> None:
    T_cw, points, measured, correct = measure_landmarks(100, outliers=0.2)
    start, uv = perturb(T_cw).requires_grad_(), measured.uv.clone().requires_grad_()
    refined = refine_pose(start, points, K=CAMERA.K, **vars(measured) | {"uv": uv}, rounds=12)
    gradients = torch.autograd.grad(refined.T_cw.sum(), (start, uv), allow_unused=True)
    assert gradients[0] is None and gradients[1][refined.inliers].any(dim=1).all()
    assert not gradients[1][~refined.inliers].any() and (~refined.inliers & ~correct).any()
    by_transform = torch.func.grad(lambda T: refine_pose(T, points, uv, CAMERA.K).T_cw.sum())(perturb(T_cw))
    assert torch.equal(by_transform, torch.zeros(4, 4, dtype=torch.float64))


def test_gradients_at_exact_measurements_are_finite() -> None:
    """All residuals vanish."""
    inputs = clean_view()
    in_camera = inputs["points"] @ inputs["T_cw"][..., :3, :3].mT + inputs["T_cw"][..., None, :3, 3]
    uv = CAMERA.project(in_camera).requires_grad_()
    refined = refine_pose(inputs["T_cw"], inputs["points"], uv, CAMERA.K, 1 / in_camera[..., 2], rounds=1)
    (gradient,) = torch.autograd.grad(refined.T_cw.square().sum() + refined.chi2.sum(), uv)
    assert gradient.isfinite().all() and gradient.any()


@pytest.mark.parametrize("transform", [torch.func.jacrev, torch.func.jacfwd])
def test_transforms_give_the_gradient(transform: Callable[..., Any]) -> None:
    inputs = clean_view()
    uv = inputs.pop("uv")
    jacobian = transform(lambda uv: refine_pose(uv=uv, **inputs, **CONVERGED).T_cw)(uv)
    expected = torch.autograd.functional.jacobian(lambda uv: refine_pose(uv=uv, **inputs, **CONVERGED).T_cw, uv)
    torch.testing.assert_close(jacobian, expected, rtol=1e-5, atol=1e-9)


# ---------------------------------------------------------------- training


def test_weights_of_features_are_learnt_through_the_poses_of_a_batch() -> None:
    """A quarter of the features is inaccurate; only the first number of their descriptors shows which."""
    torch.manual_seed(0)
    frames = camera_inputs.view(32, 50, torch.float64) | {"weights": None, "valid": None}
    true = refine_pose(**frames).T_cw
    descriptors = torch.randn(32, 50, 4, dtype=torch.float64)
    frames["uv"] += 5 * torch.randn(32, 50, 2) * (descriptors[..., :1] > 0.7)

    network = torch.nn.Sequential(torch.nn.Linear(4, 1), torch.nn.Sigmoid()).double()
    optimiser, losses = torch.optim.Adam(network.parameters(), lr=0.2), []
    for _ in range(30):
        refined = refine_pose(**frames | {"weights": network(descriptors)[..., 0]}, rounds=1)
        losses.append(se3_log(refined.T_cw @ invert(true)).square().sum())
        optimiser.zero_grad()
        losses[-1].backward()
        optimiser.step()
    assert losses[-1] < 0.5 * losses[0]
    assert network[0].weight[0, 0] < -3 * network[0].weight[0, 1:].abs().max()


def test_example_of_the_documentation_runs() -> None:
    finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner(verbose=False)
    for example in finder.find(refine_pose, "refine_pose", globs={}):
        runner.run(example)
    assert runner.summarize(verbose=False) == (0, 9)


def test_prediction_that_is_not_finite_does_not_affect_the_others_of_a_batch() -> None:
    inputs = camera_inputs.view(3, 30, torch.float64)
    del inputs["valid"]
    expected = refine_pose(**inputs).T_cw
    inputs["T_cw"][1] = torch.nan
    found = refine_pose(**inputs)
    torch.testing.assert_close(found.T_cw[::2], expected[::2])
    assert found.T_cw[1, :3].isnan().all() and not found.inliers[1].any()


def test_prediction_that_is_not_finite_does_not_change_the_gradients_of_shared_values() -> None:
    inputs, sigma = camera_inputs.view(3, 30, torch.float64), torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    del inputs["valid"]
    alone = {name: each[::2] for name, each in inputs.items()}
    refine_pose(**alone | {"pixel_sigma": sigma}).T_cw.sum().backward()
    expected, sigma.grad = sigma.grad, None
    inputs["T_cw"][1] = torch.nan
    refine_pose(**inputs | {"pixel_sigma": sigma}).T_cw[::2].sum().backward()
    assert expected is not None and sigma.grad is not None
    torch.testing.assert_close(sigma.grad, expected)
