"""Bundle adjustment against dense algebra, SciPy and GTSAM; gauge, outliers, degenerate landmarks."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import torch
from helpers.bundle_scenes import CAMERA, DEPTH_SIGMA, Scene
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.kernels import compiler
from v3d_torch.mapping.bundle_problem import prepare_bundle
from v3d_torch.optim.robust_losses import huber
from v3d_torch.optim.schur import solve_normal_equations


def test_damped_step_equals_the_dense_solution() -> None:
    scene = Scene(poses=4, points=12, observers=3)
    free = torch.tensor([1, 3])
    damping = 1e-3

    def moved(xi: Tensor, shift: Tensor) -> Tensor:
        T_cw = scene.start.index_copy(0, free, se3_exp(xi) @ scene.start[free])
        return scene.residuals(T_cw, scene.start_points + shift)

    zeros = torch.zeros(2, 6, dtype=torch.float64), torch.zeros(12, 3, dtype=torch.float64)
    by_pose, by_point = torch.autograd.functional.jacobian(moved, zeros)
    r = moved(*zeros)
    J = torch.cat([by_pose.reshape(-1, 12), by_point.reshape(-1, 36)], dim=1)
    _, weights = huber((r * r).sum(dim=-1), scene.measured.chi2_threshold)
    weighted = (J * weights.repeat_interleave(3)[:, None]).T
    H = weighted @ J
    expected = torch.linalg.solve(H + damping * H.diagonal().diag(), -weighted @ r.flatten())

    fixed = ~torch.isin(torch.arange(4), free)
    optional = dict.fromkeys(("weights", "valid"))
    given = scene.observations | {"fixed": fixed} | optional
    problem, state, _ = prepare_bundle(scene.start, scene.start_points, **given)
    _, at_start = problem.residuals_at(state)
    xi, shift = solve_normal_equations(problem.linearise(at_start, point_count=12), damping)
    torch.testing.assert_close(torch.cat([xi.T.flatten(), shift.T.flatten()]), expected, rtol=1e-7, atol=1e-9)


def test_optimum_equals_scipy() -> None:
    scene = Scene(poses=3, points=12, observers=3)
    limit = scene.measured.chi2_threshold

    def unpack(x: np.ndarray) -> tuple[Tensor, Tensor]:
        numbers = torch.from_numpy(x)
        T_cw = torch.cat([scene.start[:1], se3_exp(numbers[:12].reshape(2, 6)) @ scene.start[1:]])
        return T_cw, scene.start_points + numbers[12:].reshape(-1, 3)

    def robust_residuals(x: np.ndarray) -> np.ndarray:
        r = scene.residuals(*unpack(x))
        squared = (r * r).sum(dim=-1)
        costs, _ = huber(squared, limit)
        return (r * (costs / squared).sqrt()[:, None]).flatten().numpy()

    best = scipy.optimize.least_squares(robust_residuals, np.zeros(12 + 36), x_scale="jac", xtol=1e-12, ftol=1e-12)
    T_cw, points = unpack(best.x)
    result = scene.adjust(iterations=30)
    assert result.cost_after == pytest.approx(2 * best.cost, rel=1e-5)
    assert se3_log(result.T_cw @ invert(T_cw)).abs().max() < 1e-4
    assert (result.points - points).norm(dim=1).max() < 1e-3


def test_optimum_equals_gtsam() -> None:
    gtsam = pytest.importorskip("gtsam")  # not on Windows
    scene = Scene(poses=5, points=60, observers=4)
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, T_wc in enumerate(invert(scene.start)):
        start.insert(k, gtsam.Pose3(T_wc.numpy()))
    for k, point in enumerate(scene.start_points):
        start.insert(1000 + k, gtsam.Point3(point.numpy()))
    graph.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3(invert(scene.start[0]).numpy())))
    # A stereo camera with a baseline of one unit of inverse depth measures (u, u - w, v) for (u, v, w = 1/z).
    stereo = gtsam.Cal3_S2Stereo(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy, 1 / CAMERA.fx)
    mono = gtsam.Cal3_S2(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy)
    A = np.array([[1.0, 0, 0], [1, 0, -1], [0, 1, 0]])
    observations = scene.measured
    for m in range(len(scene.pose)):
        (u, v), w, sigma = (
            observations.uv[m].tolist(),
            float(observations.inverse_depth[m]),
            float(observations.pixel_sigma[m]),
        )
        kernel = gtsam.noiseModel.mEstimator.Huber.Create(float(observations.chi2_threshold[m].sqrt()))
        keys = int(scene.pose[m]), 1000 + int(scene.point[m])
        if w > 0:
            noise = gtsam.noiseModel.Gaussian.Covariance(A @ np.diag([sigma**2, sigma**2, DEPTH_SIGMA**2]) @ A.T)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
            graph.add(gtsam.GenericStereoFactor3D(gtsam.StereoPoint2(u, u - w, v), noise, *keys, stereo))
        else:
            noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, sigma))
            graph.add(gtsam.GenericProjectionFactorCal3_S2(gtsam.Point2(u, v), noise, *keys, mono))
    best = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    result = scene.adjust(iterations=30)
    assert result.cost_before == pytest.approx(2 * graph.error(start), rel=1e-6)
    assert result.cost_after == pytest.approx(2 * graph.error(best), rel=1e-5)
    expected = torch.stack([torch.from_numpy(best.atPose3(k).matrix()) for k in range(5)])
    assert se3_log(result.T_cw @ expected).abs().max() < 1e-4
    points = torch.stack([torch.from_numpy(best.atPoint3(1000 + k)) for k in range(60)])
    assert (result.points - points).norm(dim=1).max() < 1e-3


def test_noise_free_scene_is_recovered() -> None:
    scene = Scene(poses=6, points=100, observers=4, noise=0.0)
    result = scene.adjust(iterations=20)
    torch.testing.assert_close(result.T_cw, scene.T_cw, rtol=0, atol=1e-7)
    torch.testing.assert_close(result.points, scene.points, rtol=0, atol=1e-6)
    assert result.cost_after < 1e-6 < result.cost_before


def test_mean_chi2_equals_the_degrees_of_freedom() -> None:
    scene = Scene(poses=6, points=400, observers=5)
    result = scene.adjust()
    degrees = (2 + (scene.measured.inverse_depth > 0)).sum() - 5 * 6 - 400 * 3
    assert float(result.chi2.sum() / degrees) == pytest.approx(1.0, abs=0.05)


def test_outliers_are_detected_and_do_not_change_the_poses() -> None:
    scene = Scene(poses=6, points=300, observers=5)
    shifted = torch.arange(len(scene.pose)) % 10 == 0
    uv = torch.where(shifted[:, None], scene.measured.uv + 40.0, scene.measured.uv)
    result = scene.adjust(uv=uv)
    clean = scene.adjust()
    assert se3_log(result.T_cw @ invert(clean.T_cw)).abs().max() < 0.005
    outlier = ~result.inliers
    assert torch.equal(outlier, result.chi2 > scene.measured.chi2_threshold)
    assert outlier[shifted].double().mean() > 0.99
    assert outlier[~shifted].double().mean() < 0.15


def test_fixed_poses_are_bit_identical() -> None:
    scene = Scene(poses=5, points=50, observers=4)
    fixed = torch.tensor([True, False, True, False, True])
    result = scene.adjust(fixed=fixed)
    assert torch.equal(result.T_cw[fixed], scene.start[fixed])
    assert not torch.equal(result.T_cw[1], scene.start[1])
    everything = torch.ones(5, dtype=torch.bool)
    only_points = scene.adjust(fixed=everything)
    assert torch.equal(only_points.T_cw, scene.start)
    assert only_points.cost_after < only_points.cost_before


def test_inputs_are_not_modified() -> None:
    scene = Scene(poses=3, points=20, observers=3)
    before = scene.start.clone(), scene.start_points.clone()
    scene.adjust()
    assert torch.equal(scene.start, before[0])
    assert torch.equal(scene.start_points, before[1])


@pytest.mark.parametrize("compiled", [False, True])
def test_unchanged_result_does_not_share_memory_with_the_input(compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiler, "ENABLED", compiled and compiler.ENABLED)
    scene = Scene(poses=3, points=20, observers=3)
    result = scene.adjust(iterations=0)
    assert torch.equal(result.T_cw, scene.start)
    assert torch.equal(result.points, scene.start_points)
    assert result.T_cw.data_ptr() != scene.start.data_ptr()
    assert result.points.data_ptr() != scene.start_points.data_ptr()


@pytest.mark.parametrize("index", [-1, 99])
@pytest.mark.parametrize(("name", "count"), [("pose", 3), ("point", 20)])
def test_index_out_of_range_is_rejected_unless_it_is_padding(name: str, count: int, index: int) -> None:
    scene = Scene(poses=3, points=20, observers=3)
    indices = getattr(scene, name).clone()
    indices[5] = index
    with pytest.raises(InputError, match=f"{name} contains the index {index}; .* at least 0 and below {count}"):
        scene.adjust(**{name: indices})
    valid = torch.arange(len(indices)) != 5
    padded, expected = scene.adjust(**{name: indices}, valid=valid), scene.adjust(valid=valid)
    assert torch.equal(padded.T_cw, expected.T_cw)
    with pytest.raises(InputError, match=f"{name} has the type torch.int32; give .* torch.int64"):
        scene.adjust(**{name: getattr(scene, name).to(torch.int32)})


def test_degenerate_points_stay_finite() -> None:
    scene = Scene(poses=5, points=40, observers=4)
    measured, point = scene.measured, scene.point
    # Point 0 is observed once without depth, 1 once with depth, 2 never; 3 is behind its cameras.
    rank = torch.arange(len(point)) % 4
    keep = ~((point <= 1) & (rank > 0)) & (point != 2)
    inverse_depth = torch.where(point == 0, 0.0, torch.where(point == 1, 0.4, measured.inverse_depth))
    observations = {
        "pose": scene.pose[keep],
        "point": point[keep],
        "uv": measured.uv[keep],
        "inverse_depth": inverse_depth[keep],
        "pixel_sigma": measured.pixel_sigma[keep],
    }
    points = scene.start_points.clone()
    points[3] = -points[3]
    result = scene.adjust(points=points, **observations)
    assert torch.isfinite(result.points).all()
    assert (result.points[:2] - points[:2]).norm(dim=1).max() < 1.0
    assert torch.equal(result.points[2], points[2])
    once = scene.adjust(T_cw=scene.T_cw, points=points, fixed=torch.ones(5, dtype=torch.bool), **observations)
    in_camera = scene.T_cw[observations["pose"][1]] @ torch.cat([once.points[1], torch.ones(1)])
    assert 1 / float(in_camera[2]) == pytest.approx(0.4, abs=1e-4)
    good = torch.arange(40) > 3
    assert (result.points - scene.points)[good].norm(dim=1).median() < 0.02


@pytest.mark.parametrize("with_gradient", [False, True], ids=["kernel", "torch"])
def test_inverse_depth_that_is_not_finite_counts_as_not_measured(with_gradient: bool) -> None:
    scene = Scene(poses=5, points=40, observers=4)
    uv = scene.measured.uv.requires_grad_(with_gradient)
    inverse_depth = scene.measured.inverse_depth.clone()
    inverse_depth[[3, 50, 99]] = torch.tensor([torch.nan, torch.inf, -torch.inf], dtype=torch.float64)
    not_measured = torch.where(inverse_depth.isfinite(), inverse_depth, 0.0)
    found, expected = (scene.adjust(uv=uv, inverse_depth=depth) for depth in (inverse_depth, not_measured))
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)
    assert found.cost_after < found.cost_before
    if with_gradient:
        by_found, by_expected = (torch.autograd.grad(each.points.sum(), uv)[0] for each in (found, expected))
        assert torch.equal(by_found, by_expected) and by_found.isfinite().all()


def test_cost_without_a_fixed_pose_reaches_the_same_minimum() -> None:
    scene = Scene(poses=4, points=50, observers=4)
    free = torch.zeros(4, dtype=torch.bool)
    result = scene.adjust(fixed=free, iterations=20)
    tied = scene.adjust(iterations=20)
    assert result.cost_after == pytest.approx(float(tied.cost_after), rel=1e-3)
    assert (result.T_cw - scene.start).abs().max() < 0.3


def test_result_is_deterministic() -> None:
    scene = Scene(poses=6, points=200, observers=4)
    first, second = (scene.adjust() for _ in range(2))
    assert torch.equal(first.T_cw, second.T_cw)
    assert torch.equal(first.points, second.points)
