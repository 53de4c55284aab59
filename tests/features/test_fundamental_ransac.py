"""Epipolar RANSAC on two views whose motion is known."""

from __future__ import annotations

from helpers.two_views import two_views

from v3d_torch.features.fundamental_ransac import epipolar_inliers


def test_epipolar_inliers_are_those_of_one_motion() -> None:
    a, b, _ = two_views(outliers=100)
    inliers = epipolar_inliers(a.uv, b.uv, threshold=1.0, iterations=500, seed=0)
    assert inliers[:300].all()
    assert inliers[300:].sum() < 15  # some outliers lie on their epipolar line by chance


def test_too_few_pairs_have_no_inliers() -> None:
    a, b, _ = two_views()
    assert not epipolar_inliers(a.uv[:7], b.uv[:7], threshold=1.0, iterations=10, seed=0).any()
