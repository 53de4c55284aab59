"""Epipolar RANSAC and PnP-RANSAC on two views whose motion is known."""

from __future__ import annotations

import pytest
import torch
from helpers.two_views import CAMERA, two_views

from v3d_torch.features.ransac import epipolar_inliers, pnp_ransac
from v3d_torch.geometry.se3 import se3_exp


def test_epipolar_inliers_are_those_of_one_motion() -> None:
    a, b, _ = two_views(outliers=100)
    inliers = epipolar_inliers(a.uv, b.uv, threshold=1.0, iterations=500, seed=0)
    assert inliers[:300].all()
    assert inliers[300:].sum() < 15  # some outliers lie on their epipolar line by chance


def test_ransac_of_too_few_points_has_no_result() -> None:
    a, b, _ = two_views()
    assert not epipolar_inliers(a.uv[:7], b.uv[:7], threshold=1.0, iterations=10, seed=0).any()
    points = CAMERA.back_project(a.uv[:5], a.depth[:5])
    pose = pnp_ransac(points, b.uv[:5], CAMERA.K, threshold=2.0, iterations=10, seed=0)
    assert not pose.found and not pose.inliers.any()


def _perturb(T: torch.Tensor, metres: float, radians: float) -> torch.Tensor:
    return se3_exp(torch.tensor([metres, -metres, metres, radians, radians, -radians], dtype=torch.float64)) @ T


def test_initial_guess_that_explains_half_of_the_points_skips_sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, T_ba = two_views(outliers=100)
    points = CAMERA.back_project(a.uv, a.depth)
    sampled = pnp_ransac(points, b.uv, CAMERA.K, threshold=2.0, iterations=100, seed=0)

    def fail(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr("v3d_torch.features.ransac._sample_epnp", fail)
    guess = _perturb(T_ba, 0.02, 0.02)
    guessed = pnp_ransac(points, b.uv, CAMERA.K, guess, threshold=2.0, iterations=100, seed=0)
    assert sampled.found and guessed.found
    torch.testing.assert_close(guessed.T_cw, sampled.T_cw, rtol=0, atol=1e-4)
    assert guessed.inliers[:300].all() and guessed.inliers.sum() == sampled.inliers.sum()


def test_wrong_initial_guess_does_not_change_the_result() -> None:
    a, b, T_ba = two_views(outliers=100)
    points = CAMERA.back_project(a.uv, a.depth)
    wrong_guess = _perturb(T_ba, 3.0, 1.0)
    without_guess, with_guess = (
        pnp_ransac(points, b.uv, CAMERA.K, guess, threshold=2.0, iterations=100, seed=0)
        for guess in (None, wrong_guess)
    )
    assert without_guess.found and with_guess.found
    assert torch.equal(without_guess.T_cw, with_guess.T_cw)
    assert torch.equal(without_guess.inliers, with_guess.inliers)


@pytest.mark.parametrize("kind", ["identical", "collinear"])
def test_degenerate_points_give_no_wrong_pose(kind: str) -> None:
    points = torch.ones(50, 3, dtype=torch.float64)
    if kind == "collinear":
        points[:, 0] = torch.linspace(-1, 1, 50)
    pose = pnp_ransac(points, CAMERA.project(points), CAMERA.K, threshold=2.0, iterations=50, seed=0)
    # Many poses explain a line; any of them is correct.
    projected = CAMERA.project(points @ pose.T_cw[:3, :3].T + pose.T_cw[:3, 3])
    assert ((projected - CAMERA.project(points)).norm(dim=1)[pose.inliers] < 3).all()
