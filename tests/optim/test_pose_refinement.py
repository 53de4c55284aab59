"""Pose refinement against autograd, SciPy and gtsam; outliers, degenerate views, conventions."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
import scipy.optimize
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.optim.pose_refinement import PoseRefinement, huber, levenberg_marquardt, refine_pose
from v3d_torch.optim.reprojection import Measurements, reprojection, reprojection_jacobian

CAMERA = PinholeCamera(fx=535.4, fy=539.2, cx=320.1, cy=247.6)
DEPTH_SIGMA = 0.0025


def view(count: int, outliers: float = 0.0, seed: int = 1) -> tuple[Tensor, Tensor, Measurements, Tensor]:
    """A pose, landmarks, what is measured of them with the noise that it claims, and which of that is right."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    T_cw = se3_exp(0.5 * normal(6))
    uv = uniform(count, 2) * torch.tensor([640.0, 480.0], dtype=torch.float64)
    depth = 0.5 + 3.5 * uniform(count)
    T_wc = invert(T_cw)
    points = CAMERA.back_project(uv, depth) @ T_wc[:3, :3].T + T_wc[:3, 3]
    sigma = 1.2 ** torch.randint(0, 8, (count,), generator=generator).to(torch.float64)
    uv = uv + sigma[:, None] * normal(count, 2)
    inverse_depth = 1 / depth + DEPTH_SIGMA * normal(count)
    inverse_depth[::3] = 0.0
    good = uniform(count) >= outliers
    uv[~good] = uniform(count, 2)[~good] * 400
    measured = Measurements(uv=uv, inverse_depth=inverse_depth, pixel_sigma=sigma, inverse_depth_sigma=DEPTH_SIGMA)
    return T_cw, points, measured, good


def refine(T_cw: Tensor, points: Tensor, measured: Measurements) -> PoseRefinement:
    return refine_pose(T_cw, points, measured, CAMERA)


def nearby(T_cw: Tensor, scale: float = 0.03) -> Tensor:
    return se3_exp(scale * torch.tensor([1.0, -1.0, 0.5, 1.0, 0.7, -1.0], dtype=torch.float64)) @ T_cw


def test_jacobian_equals_autograd() -> None:
    T_cw, points, measured, _ = view(20)

    def residuals(xi: Tensor) -> Tensor:
        T = se3_exp(xi) @ T_cw
        return reprojection(points @ T[:3, :3].T + T[:3, 3], measured, CAMERA)

    expected = torch.autograd.functional.jacobian(residuals, torch.zeros(6, dtype=torch.float64))
    jacobian = reprojection_jacobian(points @ T_cw[:3, :3].T + T_cw[:3, 3], measured, CAMERA)
    torch.testing.assert_close(jacobian, expected, rtol=1e-10, atol=1e-8)


def test_convention_residuals_are_projection_minus_measurement() -> None:
    measured = Measurements(
        uv=torch.tensor([[320.1, 247.6], [320.1, 247.6]], dtype=torch.float64),
        inverse_depth=torch.tensor([0.5, 0.0], dtype=torch.float64),
        pixel_sigma=torch.tensor([2.0, 2.0], dtype=torch.float64),
        inverse_depth_sigma=0.1,
    )
    points = torch.tensor([[0.01, 0.02, 1.0]] * 2, dtype=torch.float64)
    residuals = reprojection(points, measured, CAMERA)
    expected = [[535.4 * 0.01 / 2, 539.2 * 0.02 / 2, 0.5 / 0.1], [535.4 * 0.01 / 2, 539.2 * 0.02 / 2, 0.0]]
    torch.testing.assert_close(residuals, torch.tensor(expected, dtype=torch.float64))


def test_huber_is_continuous_and_its_weight_the_derivative() -> None:
    squared = torch.linspace(0.01, 30, 500, dtype=torch.float64, requires_grad=True)
    costs, weights = huber(squared, 7.815)
    (slope,) = torch.autograd.grad(costs.sum(), squared)
    torch.testing.assert_close(slope, weights)
    edge, _ = huber(torch.tensor([7.815 - 1e-9, 7.815 + 1e-9], dtype=torch.float64), 7.815)
    assert abs(edge[1] - edge[0]) < 1e-8
    assert huber(torch.tensor([0.0, 100.0]), torch.inf)[0].tolist() == [0.0, 100.0]


def test_levenberg_marquardt_solves_rosenbrock() -> None:
    def linearise(x: Tensor) -> tuple[float, tuple[Tensor, Tensor]]:
        r = torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])
        J = torch.tensor([[-20 * float(x[0]), 10.0], [-1.0, 0.0]], dtype=torch.float64)
        return float(r @ r), (J.T @ J, J.T @ r)

    def step(x: Tensor, system: tuple[Tensor, Tensor], damping: float) -> Tensor:
        H, g = system
        return x - torch.linalg.solve(H + damping * H.diagonal().diag(), g)

    start = torch.tensor([-1.2, 1.0], dtype=torch.float64)
    found = levenberg_marquardt(start, linearise, step, iterations=50)
    torch.testing.assert_close(found.state, torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-6)
    assert found.converged
    assert found.iterations < 50
    assert found.cost_after < 1e-10 < found.cost_before


def test_same_optimum_as_scipy() -> None:
    T_cw, points, measured, _ = view(300, outliers=0.2)
    refined = refine(nearby(T_cw), points, measured)
    keep = refined.inliers

    def residuals(xi: np.ndarray) -> np.ndarray:
        T = se3_exp(torch.from_numpy(xi)) @ T_cw
        return reprojection(points @ T[:3, :3].T + T[:3, 3], measured, CAMERA)[keep].flatten().numpy()

    best = scipy.optimize.least_squares(residuals, np.zeros(6), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    expected = se3_exp(torch.from_numpy(best.x)) @ T_cw
    # a hundredth of a standard deviation (0.1 mm, 0.1 mrad)
    assert se3_log(refined.T_cw @ invert(expected)).abs().max() < 1e-5
    torch.testing.assert_close(float(refined.chi2[keep].sum()), 2 * best.cost, rtol=1e-4, atol=0)
    torch.testing.assert_close(refined.information, torch.from_numpy(best.jac.T @ best.jac), rtol=0.05, atol=2e3)


def test_same_optimum_as_gtsam() -> None:
    T_cw, points, measured, _ = view(200)
    refined = refine(nearby(T_cw), points, measured)
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    # A stereo camera with a baseline of one unit of inverse depth measures (u, u - w, v) for (u, v, w = 1/z).
    stereo = gtsam.Cal3_S2Stereo(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy, 1 / CAMERA.fx)
    mono = gtsam.Cal3_S2(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy)
    for k in torch.nonzero(refined.inliers)[:, 0].tolist():
        (u, v), w, sigma = measured.uv[k].tolist(), float(measured.inverse_depth[k]), float(measured.pixel_sigma[k])
        start.insert(k + 1, gtsam.Point3(points[k].numpy()))
        graph.add(gtsam.NonlinearEqualityPoint3(k + 1, gtsam.Point3(points[k].numpy())))
        if w > 0:
            A = np.array([[1.0, 0, 0], [1, 0, -1], [0, 1, 0]])
            noise = gtsam.noiseModel.Gaussian.Covariance(A @ np.diag([sigma**2, sigma**2, DEPTH_SIGMA**2]) @ A.T)
            graph.add(gtsam.GenericStereoFactor3D(gtsam.StereoPoint2(u, u - w, v), noise, 0, k + 1, stereo))
        else:
            noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
            graph.add(gtsam.GenericProjectionFactorCal3_S2(gtsam.Point2(u, v), noise, 0, k + 1, mono))
    start.insert(0, gtsam.Pose3(invert(T_cw).numpy()))
    best = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize().atPose3(0).matrix()
    assert se3_log(refined.T_cw @ torch.from_numpy(best)).abs().max() < 1e-5


@pytest.mark.parametrize("outliers", [0.0, 0.2, 0.4])
def test_outliers_are_found_and_do_not_matter(outliers: float) -> None:
    T_cw, points, measured, good = view(500, outliers)
    refined = refine(nearby(T_cw), points, measured)
    kept = float((refined.inliers & good).sum() / good.sum())
    assert abs(kept - 0.95) < 0.03  # what the limits are made for
    assert (refined.inliers & ~good).sum() <= 0.02 * len(good)
    error = se3_log(refined.T_cw @ invert(T_cw))
    # squared error in sigmas of six unknowns: 99.99 % stay below 28
    assert error @ refined.information @ error < 28


def test_depth_alone_gives_the_distance() -> None:
    points = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64)
    seen_at = Measurements(
        uv=torch.tensor([[CAMERA.cx, CAMERA.cy]], dtype=torch.float64),
        inverse_depth=torch.tensor([1 / 1.9], dtype=torch.float64),
        pixel_sigma=torch.ones(1, dtype=torch.float64),
        inverse_depth_sigma=DEPTH_SIGMA,
    )
    refined = refine_pose(torch.eye(4, dtype=torch.float64), points, seen_at, CAMERA)
    seen = refined.T_cw[:3, :3] @ points[0] + refined.T_cw[:3, 3]
    assert abs(float(seen[2]) - 1.9) < 1e-3
    assert refined.inliers.tolist() == [True]


def test_nothing_seen_leaves_the_prediction() -> None:
    T_cw, points, measured, _ = view(4)
    none = Measurements(
        uv=measured.uv[:0],
        inverse_depth=measured.inverse_depth[:0],
        pixel_sigma=measured.pixel_sigma[:0],
        inverse_depth_sigma=DEPTH_SIGMA,
    )
    refined = refine(T_cw, points[:0], none)
    torch.testing.assert_close(refined.T_cw, T_cw, rtol=0, atol=1e-14)
    assert refined.inliers.shape == (0,)


def test_points_behind_the_camera_are_no_inliers() -> None:
    T_cw, points, measured, _ = view(100)
    in_camera = points @ T_cw[:3, :3].T + T_cw[:3, 3]
    in_camera[7] = -in_camera[7]  # projects to the same pixel
    measured.inverse_depth[7] = 0.0
    T_wc = invert(T_cw)
    refined = refine(T_cw, in_camera @ T_wc[:3, :3].T + T_wc[:3, 3], measured)
    assert not refined.inliers[7]
    assert torch.isinf(refined.chi2[7])
    assert refined.inliers.sum() > 85
    assert se3_log(refined.T_cw @ T_wc).abs().max() < 0.005


def test_deterministic() -> None:
    T_cw, points, measured, _ = view(500, 0.3)
    first, second = (refine(nearby(T_cw), points, measured) for _ in range(2))
    assert torch.equal(first.T_cw, second.T_cw)
    assert torch.equal(first.inliers, second.inliers)
