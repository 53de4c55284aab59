"""ORB, RANSAC and motion between two views of a made-up scene whose motion is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from v3d_torch.config import Config
from v3d_torch.features.features import Features, select_evenly
from v3d_torch.features.orb import ORB
from v3d_torch.features.ransac import epipolar_inliers, pnp_ransac
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.odometry.motion_estimator import MotionEstimator

CAMERA = PinholeCamera(500.0, 500.0, 319.5, 239.5)


def _motion(angle: float = 0.05) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(angle), math.sin(angle)
    T[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    T[:3, 3] = torch.tensor([0.05, -0.02, 0.03])
    return T


def _views(outliers: int = 0, noise: float = 0.0) -> tuple[Features, Features, torch.Tensor]:
    """The same 400 points seen by two cameras; the last ``outliers`` are somewhere else in the second."""
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(400, 2, generator=generator, dtype=torch.float64) * torch.tensor([520.0, 400.0]) + 40
    z = torch.rand(400, generator=generator, dtype=torch.float64) * 3 + 1
    T_ba = _motion()
    points = CAMERA.back_project(uv, z) @ T_ba[:3, :3].T + T_ba[:3, 3]
    seen = CAMERA.project(points)
    seen = seen + noise * torch.randn(400, 2, generator=generator, dtype=torch.float64)
    if outliers:
        seen[-outliers:] += 30 + 60 * torch.rand(outliers, 2, generator=generator, dtype=torch.float64)
    descriptors = torch.randint(0, 256, (400, 32), generator=generator, dtype=torch.uint8)
    octave = torch.zeros(400, dtype=torch.int64)

    def view(uv: torch.Tensor, z: torch.Tensor) -> Features:
        return Features(uv, uv.round().long(), z, octave, descriptors)

    return view(uv, z), view(seen, points[:, 2]), T_ba


def test_convention_motion_maps_points_of_a_to_b() -> None:
    a, b, T_ba = _views()
    motion = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)(a, b)
    assert motion is not None
    assert torch.allclose(motion.T_ba, T_ba, atol=1e-6)
    assert motion.pairs.shape == (400, 2)


def test_motion_survives_a_third_of_outliers() -> None:
    a, b, T_ba = _views(outliers=130, noise=0.3)
    motion = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)(a, b)
    assert motion is not None
    assert torch.allclose(motion.T_ba, T_ba, atol=5e-3)
    assert (motion.pairs[:, 0] >= 270).sum() < 10


def test_motion_is_the_same_each_time() -> None:
    a, b, _ = _views(outliers=130, noise=0.5)
    estimate = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=7)
    first, second = estimate(a, b), estimate(a, b)
    assert first is not None
    assert second is not None
    assert torch.equal(first.T_ba, second.T_ba)


def test_no_motion_without_depth_or_matches() -> None:
    a, b, _ = _views()
    estimate = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)
    flat = Features(a.uv, a.pixel, torch.zeros_like(a.depth), a.octave, a.descriptors)
    assert estimate(flat, b) is None
    assert estimate(a, b[:5]) is None


def test_epipolar_inliers_are_those_of_one_motion() -> None:
    a, b, _ = _views(outliers=100)
    inliers = epipolar_inliers(a.uv, b.uv, threshold=1.0, iterations=500, seed=0)
    assert inliers[:300].all()
    assert inliers[300:].sum() < 15  # some land on their epipolar line by chance


def test_ransac_of_too_few_points_is_empty() -> None:
    a, b, _ = _views()
    assert not epipolar_inliers(a.uv[:7], b.uv[:7], threshold=1.0, iterations=10, seed=0).any()
    points = CAMERA.back_project(a.uv[:5], a.depth[:5])
    assert pnp_ransac(points, b.uv[:5], CAMERA, threshold=2.0, iterations=10, seed=0) is None


def _near(T: torch.Tensor, metres: float, radians: float) -> torch.Tensor:
    return se3_exp(torch.tensor([metres, -metres, metres, radians, radians, -radians], dtype=torch.float64)) @ T


def test_a_guess_that_explains_half_of_the_points_spares_the_sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, T_ba = _views(outliers=100)
    points = CAMERA.back_project(a.uv, a.depth)
    sampled = pnp_ransac(points, b.uv, CAMERA, threshold=2.0, iterations=100, seed=0)

    def none(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr("v3d_torch.features.ransac._sampled", none)
    guess = _near(T_ba, 0.02, 0.02)
    guessed = pnp_ransac(points, b.uv, CAMERA, threshold=2.0, iterations=100, seed=0, guess=guess)
    assert sampled is not None and guessed is not None
    torch.testing.assert_close(guessed[0], sampled[0], rtol=0, atol=1e-4)
    assert guessed[1][:300].all() and guessed[1].sum() == sampled[1].sum()


def test_a_wrong_guess_costs_nothing_but_time() -> None:
    a, b, T_ba = _views(outliers=100)
    points = CAMERA.back_project(a.uv, a.depth)
    guess = _near(T_ba, 3.0, 1.0)
    plain, misled = (
        pnp_ransac(points, b.uv, CAMERA, threshold=2.0, iterations=100, seed=0, guess=told) for told in (None, guess)
    )
    assert plain is not None and misled is not None
    assert torch.equal(plain[0], misled[0]) and torch.equal(plain[1], misled[1])


@pytest.mark.parametrize("kind", ["identical", "collinear"])
def test_degenerate_points_give_no_wrong_pose(kind: str) -> None:
    points = torch.ones(50, 3, dtype=torch.float64)
    if kind == "collinear":
        points[:, 0] = torch.linspace(-1, 1, 50)
    found = pnp_ransac(points, CAMERA.project(points), CAMERA, threshold=2.0, iterations=50, seed=0)
    if found is not None:  # many poses explain a line: whichever comes back must be one of them
        T_cw, inliers = found
        seen = CAMERA.project(points @ T_cw[:3, :3].T + T_cw[:3, 3])
        assert ((seen - CAMERA.project(points)).norm(dim=1)[inliers] < 3).all()


def _image() -> torch.Tensor:
    generator = np.random.default_rng(0)
    blocks = generator.integers(0, 255, (3, 24, 32), dtype=np.uint8)
    return torch.from_numpy(blocks.repeat(20, axis=1).repeat(20, axis=2))


def test_orb_reads_depth_under_each_feature() -> None:
    depth = torch.arange(480 * 640, dtype=torch.float32).reshape(1, 480, 640) / 1e5 + 1
    features = ORB(Config().features, CAMERA)(_image(), depth)
    assert len(features) > 500
    u, v = features.pixel.unbind(dim=1)
    assert torch.equal(features.depth, depth[0, v, u].double())
    assert (features.octave.unique() == torch.arange(8)).all()
    assert torch.allclose(features.inverse_depth * features.depth, torch.ones(len(features), dtype=torch.float64))


def test_orb_leaves_out_far_depth_and_keeps_the_feature() -> None:
    features = ORB(Config().features, CAMERA)(_image(), torch.full((1, 480, 640), 9.0))
    assert len(features) > 500
    assert (features.depth == 0).all()
    assert (features.inverse_depth == 0).all()


def test_orb_of_a_blank_image_is_empty() -> None:
    features = ORB(Config().features, CAMERA)(torch.zeros(3, 480, 640, dtype=torch.uint8), torch.ones(1, 480, 640))
    assert len(features) == 0


def test_features_on_a_mask() -> None:
    features = ORB(Config().features, CAMERA)(_image(), torch.ones(1, 480, 640))
    mask = torch.zeros(480, 640, dtype=torch.bool)
    mask[:, :320] = True
    assert torch.equal(features.in_mask(mask), features.pixel[:, 0] < 320)


def test_spread_takes_evenly_from_the_cells() -> None:
    generator = torch.Generator().manual_seed(0)
    crowded = torch.randint(0, 32, (500, 2), generator=generator)
    sparse = torch.randint(0, 640, (60, 2), generator=generator)
    pixel = torch.cat([crowded, sparse])
    chosen = select_evenly(pixel, 80, 32)
    assert len(chosen) == 80
    assert (chosen >= 500).sum() >= 55  # the sparse ones come first, but where they crowd as well
    assert torch.equal(chosen, chosen.sort().values)
    assert torch.equal(select_evenly(pixel, 1000, 32), torch.arange(560))
    assert len(select_evenly(pixel, 0, 32)) == 0
