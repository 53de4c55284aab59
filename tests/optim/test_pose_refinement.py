"""Pose refinement against SciPy and gtsam; outliers and degenerate measurements."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
import scipy.optimize
import torch
from helpers.measured_landmarks import CAMERA, INVERSE_DEPTH_SIGMA, measure_landmarks
from torch import Tensor

from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.optim.pose_refinement import PoseRefinement, refine_pose
from v3d_torch.optim.reprojection import Measurements, reprojection_residuals


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


def test_refined_pose_equals_the_optimum_of_gtsam() -> None:
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


def test_refinement_is_deterministic() -> None:
    T_cw, points, measured, _ = measure_landmarks(500, 0.3)
    first, second = (refine(perturb(T_cw), points, measured) for _ in range(2))
    assert torch.equal(first.T_cw, second.T_cw)
    assert torch.equal(first.inliers, second.inliers)
