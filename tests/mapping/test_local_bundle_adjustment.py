"""Local bundle adjustment on a scene with known poses: accuracy, locality, outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from helpers.sparse_maps import CAMERA, EYE, features, make_map, uniform
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.local_bundle_adjustment import local_bundle_adjust
from v3d_torch.mapping.sparse_map import SparseMap


class Walk:
    """A camera that moves sideways past 300 points: accurate measurements with noise, and inaccurate initial poses.

    Args:
        keyframes: Number of keyframes.
        error: Standard deviation of the initial poses, metres and radians.
        change: Changes the observed features.
    """

    def __init__(
        self, keyframes: int, error: float, change: Callable[[Features], Features] = lambda observed: observed
    ) -> None:
        self.change = change
        # Twice the width of the image: points enter and leave the image.
        self.points = CAMERA.back_project(features(300, seed=1).uv * torch.tensor([2, 1]), 2 + uniform(300, seed=2))
        self.map = make_map()
        zero = torch.zeros(keyframes, dtype=torch.float64)
        steps = torch.arange(keyframes, dtype=torch.float64)
        self.T_cw = se3_exp(torch.stack([-0.1 * steps, zero, zero, zero, -0.01 * steps, zero], dim=1))
        noise = error * torch.randn(keyframes, 6, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
        noise[0] = 0
        initial = se3_exp(noise) @ self.T_cw
        ids = torch.full((300,), -1)
        for k in range(keyframes):
            observed, points = self.observe(k)
            keyframe = self.map.insert_keyframe(k, k / 30, initial[k], observed, ids[points])
            ids[points] = keyframe.landmarks

    def observe(self, k: int) -> tuple[Features, Tensor]:
        """Features of a keyframe, and the index of the point of each feature."""
        in_camera = self.points @ self.T_cw[k, :3, :3].T + self.T_cw[k, :3, 3]
        uv = CAMERA.project(in_camera)
        points = torch.nonzero(((uv > 0) & (uv < torch.tensor([640, 480]))).all(dim=1))[:, 0]
        noise = 0.2 * torch.randn(len(points), 2, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
        zeros = torch.zeros(len(points), dtype=torch.int64)
        descriptors = torch.zeros(len(points), 32, dtype=torch.uint8)
        uv = uv[points] + noise
        return self.change(Features(uv, uv.long(), in_camera[points, 2], zeros, descriptors)), points

    def errors(self) -> Tensor:
        """Position error of each keyframe, metres."""
        T_wc = invert(torch.stack([keyframe.T_cw for keyframe in self.map.keyframes]))
        return (T_wc - invert(self.T_cw))[:, :3, 3].norm(dim=1)


def adjust(sparse_map: SparseMap, config: Config) -> None:
    """Adjust the neighbourhood of the newest keyframe."""
    adjustment = local_bundle_adjust(sparse_map, sparse_map.keyframes[-1], config, CAMERA)
    assert adjustment is not None
    adjustment.apply(sparse_map)


def test_adjusted_poses_are_accurate_and_the_first_keyframe_stays() -> None:
    walk = Walk(keyframes=6, error=0.01)
    before = walk.errors()
    for _ in range(3):
        adjust(walk.map, Config())
    assert before.max() > 0.02
    assert walk.errors().max() < 0.003
    assert torch.equal(walk.map.keyframes[0].T_cw, EYE)


def test_map_is_unchanged_until_the_adjustment_is_applied() -> None:
    walk = Walk(keyframes=6, error=0.01)
    before, points = walk.map.T_cw, walk.map.landmarks["point"].clone()
    adjustment = local_bundle_adjust(walk.map, walk.map.keyframes[-1], Config(), CAMERA)
    assert adjustment is not None
    assert torch.equal(walk.map.T_cw, before) and torch.equal(walk.map.landmarks["point"], points)
    assert walk.map.observations["valid"].all()
    adjustment.apply(walk.map)
    torch.testing.assert_close(walk.map.T_cw, adjustment.T_cw, rtol=0, atol=0)
    assert (walk.map.T_cw - before).abs().max() > 0.005


def test_adjustment_moves_only_the_keyframes_of_its_window() -> None:
    walk = Walk(keyframes=12, error=0.01)
    before = [keyframe.T_cw.clone() for keyframe in walk.map.keyframes]
    config = load_config(overrides=["mapping.bundle_keyframes=4"])
    adjust(walk.map, config)
    moved = [not torch.equal(keyframe.T_cw, old) for keyframe, old in zip(walk.map.keyframes, before, strict=True)]
    assert moved == [False] * 8 + [True] * 4


def test_first_keyframe_stays_in_a_window_that_other_keyframes_fix() -> None:
    walk = Walk(keyframes=6, error=0.01)
    before = walk.map.T_cw
    config = load_config(overrides=["mapping.bundle_keyframes=3"])
    adjustment = local_bundle_adjust(walk.map, walk.map.keyframes[1], config, CAMERA)
    assert adjustment is not None
    moved = (adjustment.T_cw != before).flatten(1).any(dim=1)
    assert moved.tolist() == [False, True, True, False, False, False]


def test_adjustment_is_disabled_without_bundle_keyframes() -> None:
    walk = Walk(keyframes=4, error=0.01)
    config = load_config(overrides=["mapping.bundle_keyframes=0"])
    assert local_bundle_adjust(walk.map, walk.map.keyframes[-1], config, CAMERA) is None


def test_adjustment_removes_outlier_observations() -> None:
    walk = Walk(keyframes=6, error=0.0)
    table = walk.map.observations
    outliers = torch.nonzero((table["keyframe"] == 5) & (table["landmark"] % 20 == 0))[:, 0]
    table["uv"][outliers] += 50.0
    adjust(walk.map, Config())
    assert len(outliers) > 5
    assert not table["valid"][outliers].any()
    assert table["valid"].double().mean() > 0.98
    assert (walk.map.keyframes[5].landmarks[table["feature"][outliers]] == -1).all()
    assert walk.errors().max() < 0.006
    adjust(walk.map, Config())  # without the outliers
    assert walk.errors().max() < 0.003


def test_features_of_large_uncertainty_have_little_influence() -> None:
    def adjusted_errors(shift: float, ratio: float) -> Tensor:
        """Errors if every second feature is shifted along u, pixels, and has a relative uncertainty."""

        def change(observed: Features) -> Features:
            every_second = (torch.arange(len(observed)) % 2 == 0)[:, None]
            uv = torch.where(every_second, observed.uv + torch.tensor([shift, 0.0]), observed.uv)
            ratios = torch.where(every_second, ratio, 1.0).double().expand(-1, 2)
            return replace(observed, uv=uv, sigma_ratio=ratios)

        walk = Walk(5, error=0.01, change=change)
        adjust(walk.map, Config())
        return walk.errors()

    def influence(ratio: float) -> float:
        """Change of the errors by a shift of two pixels, which is no outlier."""
        return float((adjusted_errors(2.0, ratio) - adjusted_errors(0.0, ratio)).abs().max())

    assert influence(ratio=30.0) < 0.02 * influence(ratio=1.0)
