"""Frame-to-frame registration of two views whose motion is known."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.two_views import CAMERA, two_views

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.odometry.motion_estimator import MotionEstimator, RelativeMotion
from v3d_torch.types import MIN_INTERVAL


def test_convention_motion_maps_points_of_a_to_b() -> None:
    a, b, T_ba = two_views()
    motion = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)(a, b)
    assert motion is not None
    assert torch.allclose(motion.T_ba, T_ba, atol=1e-6)
    assert motion.inlier_matches.shape == (400, 2)


def test_motion_is_correct_with_a_third_of_outliers() -> None:
    a, b, T_ba = two_views(outliers=130, noise=0.3)
    motion = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)(a, b)
    assert motion is not None
    assert torch.allclose(motion.T_ba, T_ba, atol=5e-3)
    assert (motion.inlier_matches[:, 0] >= 270).sum() < 10


def test_with_a_prediction_a_limited_number_of_features_is_matched() -> None:
    a, b, T_ba = two_views()
    config = Config().odometry.model_copy(update={"max_features": 50})
    estimate = MotionEstimator(config, Config().features, CAMERA, seed=0)
    alone, predicted = estimate(a, b), estimate(a, b, initial_guess=T_ba)
    assert alone is not None and len(alone.inlier_matches) == 400
    assert predicted is not None and 20 <= len(predicted.inlier_matches) <= 50
    assert torch.allclose(predicted.T_ba, T_ba, atol=1e-6)
    extent = a.uv.amax(dim=0) - a.uv.amin(dim=0)
    matched = a.uv[predicted.inlier_matches[:, 0]]
    assert bool((matched.amax(dim=0) - matched.amin(dim=0) > 0.8 * extent).all())  # spread over the image


def test_motion_is_deterministic() -> None:
    a, b, _ = two_views(outliers=130, noise=0.5)
    estimate = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=7)
    first, second = estimate(a, b), estimate(a, b)
    assert first is not None
    assert second is not None
    assert torch.equal(first.T_ba, second.T_ba)


def test_number_of_matched_features_is_limited_with_an_initial_guess() -> None:
    """The selected features are in different cells; without a guess all features are matched."""
    a, b, T_ba = two_views()
    config = Config().odometry.model_copy(update={"max_features": 50})
    estimate = MotionEstimator(config, Config().features, CAMERA, seed=0)
    limited, unlimited = estimate(a, b, initial_guess=T_ba), estimate(a, b)
    assert limited is not None and unlimited is not None
    assert len(limited.matches) == len(limited.inlier_matches) == 50 and len(unlimited.matches) == 400
    cells = a.pixel[limited.matches[:, 0]] // Config().features.cell
    assert len(cells.unique(dim=0)) == 50
    assert torch.allclose(limited.T_ba, T_ba, atol=1e-6)


def test_features_without_depth_do_not_count_among_the_matched_ones() -> None:
    a, b, T_ba = two_views()
    depth = torch.where(torch.arange(400) % 4 == 0, a.depth, 0.0)
    config = Config().odometry.model_copy(update={"max_features": 50})
    estimate = MotionEstimator(config, Config().features, CAMERA, seed=0)
    motion = estimate(Features(a.uv, a.pixel, depth, a.octave, a.descriptors), b, initial_guess=T_ba)
    assert motion is not None and len(motion.matches) == 50
    assert (motion.matches[:, 0] % 4 == 0).all()


def test_speed_is_bounded_also_between_frames_that_were_received_at_once() -> None:
    xi = torch.tensor([0.03, 0, 0, 0, 0.02, 0], dtype=torch.float64)
    motion = RelativeMotion(se3_exp(xi), torch.zeros(0, 2, dtype=torch.int64))
    assert motion.is_plausible(1 / 30, 5.0) and motion.is_plausible(0.002, 5.0)
    assert not motion.is_plausible(0.002, 2.0)
    torch.testing.assert_close(motion.velocity(1 / 30), 30 * xi)
    torch.testing.assert_close(motion.velocity(0.002), xi / MIN_INTERVAL)


def test_no_motion_without_depth_or_matches() -> None:
    a, b, _ = two_views()
    estimate = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)
    without_depth = Features(a.uv, a.pixel, torch.zeros_like(a.depth), a.octave, a.descriptors)
    assert estimate(without_depth, b) is None
    assert estimate(a, b[:5]) is None


def test_place_whose_depth_is_of_another_scale_is_not_recognised() -> None:
    """As with a wrong depth scale in a known map. The motion since the previous frame does not depend on this depth."""
    a, b, T_ba = two_views()
    estimate = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)
    for factor, is_recognised in ((0.5, False), (0.8, False), (0.9, True), (1.1, True), (1.3, False), (0.0, True)):
        scaled = replace(b, depth=factor * b.depth)
        assert (estimate(a, scaled) is not None) is is_recognised, factor
        assert estimate(a, scaled, initial_guess=T_ba) is not None
