"""PnP-RANSAC on two views whose motion is known, and against OpenCV; padding, P3P, gradients."""

from __future__ import annotations

import cv2
import pytest
import torch
from helpers import camera_inputs
from helpers.two_views import CAMERA, two_views
from kornia.core.exceptions import ShapeError

from v3d_torch.features.pnp_ransac import pnp_ransac
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.optim.pose_refinement import refine_pose


def test_too_few_points_give_no_pose() -> None:
    a, b, _ = two_views()
    points = CAMERA.back_project(a.uv[:5], a.depth[:5])
    pose = pnp_ransac(points, b.uv[:5], CAMERA.K, threshold=2.0, iterations=10, seed=0)
    assert not pose.found and not pose.inliers.any()


def test_initial_guess_of_another_shape_is_rejected() -> None:
    a, b, T_ba = two_views()
    with pytest.raises(ShapeError):
        pnp_ransac(CAMERA.back_project(a.uv, a.depth), b.uv, CAMERA.K, initial_guess=T_ba[:3])


def _perturb(T: torch.Tensor, metres: float, radians: float) -> torch.Tensor:
    return se3_exp(torch.tensor([metres, -metres, metres, radians, radians, -radians], dtype=torch.float64)) @ T


def test_initial_guess_that_explains_half_of_the_points_skips_sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, T_ba = two_views(outliers=100)
    points = CAMERA.back_project(a.uv, a.depth)
    sampled = pnp_ransac(points, b.uv, CAMERA.K, threshold=2.0, iterations=100, seed=0)

    def fail(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr("v3d_torch.features.pnp_ransac._sample_opencv", fail)
    guess = _perturb(T_ba, 0.02, 0.02)
    guessed = pnp_ransac(points, b.uv, CAMERA.K, guess, threshold=2.0, iterations=100, seed=0)
    assert sampled.found and guessed.found
    torch.testing.assert_close(guessed.T_cw, sampled.T_cw, rtol=0, atol=1e-4)
    assert guessed.inliers[:300].all() and guessed.inliers.sum() == sampled.inliers.sum()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16, torch.int64])
def test_pose_does_not_depend_on_the_dtype_of_the_initial_guess(dtype: torch.dtype) -> None:
    a, b, _ = two_views(outliers=100)
    points = CAMERA.back_project(a.uv, a.depth)
    guess = torch.eye(4, dtype=torch.float64)  # exact in all dtypes
    found, expected = (pnp_ransac(points, b.uv, CAMERA.K, each) for each in (guess.to(dtype), guess))
    assert expected.inliers[:300].all() and torch.equal(found.inliers, expected.inliers)
    assert found.T_cw.dtype == torch.float64 and torch.equal(found.T_cw, expected.T_cw)


@pytest.mark.parametrize("scale", [1.0, -1.0, 0.0, torch.nan])
def test_initial_guess_without_inliers_is_no_pose(scale: float) -> None:
    """All points are at one place, before or behind the camera, or nowhere, but their pixels are not."""
    uv = 400 * torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points, identity = torch.full((50, 3), scale, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    found = pnp_ransac(points, uv, CAMERA.K, identity)
    assert not found.found and not found.inliers.any() and torch.equal(found.T_cw, identity)


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


def test_pose_is_as_accurate_as_that_of_opencv() -> None:
    """Root mean square over 20 draws of the noise, with 150 outliers among 400 points."""
    a, b, T_ba = two_views(outliers=150)
    points, generator = CAMERA.back_project(a.uv, a.depth), torch.Generator().manual_seed(0)
    uv = b.uv + torch.randn(20, 400, 2, generator=generator, dtype=torch.float64)
    found = pnp_ransac(points, uv, CAMERA.K, threshold=3.0)
    assert found.inliers[:, :250].double().mean() > 0.95 and found.inliers[:, 250:].sum() < 100
    opencv = torch.eye(4, dtype=torch.float64).repeat(20, 1, 1)
    for k, pixels in enumerate(uv):
        _, rotation, translation, inliers = cv2.solvePnPRansac(
            points.numpy(), pixels.numpy(), CAMERA.K.numpy(), None, reprojectionError=3.0, confidence=0.999
        )
        opencv[k, :3, :3] = torch.from_numpy(cv2.Rodrigues(rotation)[0])
        opencv[k, :3, 3] = torch.from_numpy(translation[:, 0])
        assert int(found.inliers[k].sum()) > len(inliers) - 5
    ours, theirs = (se3_log(T @ invert(T_ba)).norm(dim=1).square().mean().sqrt() for T in (found.T_cw, opencv))
    assert ours <= 1.1 * theirs < 0.005


@pytest.mark.parametrize("traced", [False, True])
def test_two_thirds_of_outliers_on_one_side_do_not_move_the_pose(traced: bool) -> None:
    a, b, T_ba = two_views(noise=0.5)
    points, uv = CAMERA.back_project(a.uv, a.depth), b.uv.clone()
    uv[130:] += 20 + 80 * torch.rand(270, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    if traced:
        batch = torch.func.vmap(lambda u: pnp_ransac(points, u, CAMERA.K))(uv[None])
        found = type(batch)(*(each[0] for each in batch))
    else:
        found = pnp_ransac(points, uv, CAMERA.K)
    assert found.inliers[:130].all() and found.inliers[130:].sum() < 10
    assert float(se3_log(found.T_cw @ invert(T_ba)).norm()) < 0.005


def test_torch_gives_the_same_poses_as_opencv() -> None:
    """`torch.func.vmap` traces the function, so that torch finds the hypotheses."""
    a, b, _ = two_views(outliers=150, noise=1.0)
    points, uv = torch.stack([CAMERA.back_project(a.uv, a.depth)] * 2), torch.stack([b.uv, b.uv + 1.0])
    mapped = torch.func.vmap(lambda X, u: pnp_ransac(X, u, CAMERA.K, iterations=100))(points, uv)
    expected = pnp_ransac(points, uv, CAMERA.K)
    assert mapped.found.all() and expected.found.all()
    torch.testing.assert_close(mapped.T_cw, expected.T_cw, rtol=0, atol=2e-3)
    assert (mapped.inliers != expected.inliers).sum() < 20


def test_problems_of_a_batch_are_solved_as_alone() -> None:
    """One is padded, one has too few points, and one needs no RANSAC thanks to its prediction."""
    a, b, T_ba = two_views(outliers=100, noise=0.5)
    points, uv = CAMERA.back_project(a.uv, a.depth), b.uv.clone()
    valid = torch.stack([torch.arange(400) % 3 > 0, torch.arange(400) < 5, torch.ones(400, dtype=torch.bool)])
    guess = torch.stack([_perturb(T_ba, 3.0, 1.0), T_ba, _perturb(T_ba, 0.02, 0.02)])
    padded = torch.where(valid[..., None], uv, torch.nan)
    found = pnp_ransac(points.expand(3, 400, 3), padded, CAMERA.K, guess, valid)
    assert found.found.tolist() == [True, False, True]
    for k in (0, 2):
        alone = pnp_ransac(points[valid[k]], uv[valid[k]], CAMERA.K, guess[k])
        torch.testing.assert_close(found.T_cw[k], alone.T_cw, rtol=0, atol=1e-9)
        assert torch.equal(found.inliers[k, valid[k]], alone.inliers) and not found.inliers[k, ~valid[k]].any()


@pytest.mark.parametrize("seed", [2**31, 2**63])
def test_any_seed_is_accepted(seed: int) -> None:
    a, b, T_ba = two_views(outliers=100)
    found = pnp_ransac(CAMERA.back_project(a.uv, a.depth), b.uv, CAMERA.K, seed=seed)
    torch.testing.assert_close(found.T_cw, T_ba, rtol=0, atol=1e-4)


def test_pose_has_gradients() -> None:
    a, b, _ = two_views(noise=0.5)
    points, uv = CAMERA.back_project(a.uv, a.depth)[:40].requires_grad_(), b.uv[:40].clone().requires_grad_()
    found = pnp_ransac(points, uv, CAMERA.K)
    by_points, by_uv = torch.autograd.grad(found.T_cw.sum(), (points, uv))
    assert by_points[found.inliers].any() and by_uv[found.inliers].any()
    sigma = torch.full((40,), 4.0 / 5.991**0.5, dtype=torch.float64)
    refined = refine_pose(found.T_cw.detach(), points, uv, CAMERA.K, pixel_sigma=sigma, rounds=2)
    for one, other in zip((by_points, by_uv), torch.autograd.grad(refined.T_cw.sum(), (points, uv)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-2, atol=1e-5)


def test_prediction_that_is_not_finite_counts_as_none() -> None:
    inputs = camera_inputs.points_in_view(1, 30, torch.float64)
    inputs = {name: each[0] for name, each in inputs.items()}
    guess = torch.full((4, 4), torch.nan, dtype=torch.float64)
    found, expected = pnp_ransac(**inputs, initial_guess=guess), pnp_ransac(**inputs)
    assert found.found and torch.equal(found.inliers, expected.inliers)
    torch.testing.assert_close(found.T_cw, expected.T_cw)
    two = pnp_ransac(**inputs, initial_guess=torch.stack([expected.T_cw, guess]))
    assert two.found.all() and two.T_cw.isfinite().all()
    few = {name: each[:2] if name != "K" else each for name, each in inputs.items()}
    assert not pnp_ransac(**few, initial_guess=guess).found


def test_prediction_that_is_not_finite_does_not_change_the_gradients() -> None:
    inputs = camera_inputs.points_in_view(2, 30, torch.float64)
    inputs["valid"] = torch.ones(2, 30, dtype=torch.bool)
    points = inputs.pop("points").requires_grad_()
    expected = pnp_ransac(points, **inputs)
    guess = torch.stack([expected.T_cw[0].detach(), torch.full((4, 4), torch.nan, dtype=torch.float64)])
    found = pnp_ransac(points, **inputs, initial_guess=guess)
    assert expected.found.all()
    by_guess, without_guess = (torch.autograd.grad(each.T_cw.sum(), points)[0] for each in (found, expected))
    assert without_guess.any()
    torch.testing.assert_close(by_guess, without_guess, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5])
def test_too_few_points_of_a_mapped_batch_give_no_pose(count: int) -> None:
    inputs = camera_inputs.points_in_view(2, count, torch.float64)
    found = torch.func.vmap(pnp_ransac)(inputs["points"], inputs["uv"], inputs["K"])
    assert found.found.tolist() == [False, False] and not found.inliers.any()
    torch.testing.assert_close(found.T_cw, torch.eye(4, dtype=torch.float64).expand(2, 4, 4))


@pytest.mark.parametrize("iterations", [5, 20])
def test_few_samples_never_replace_a_prediction_by_a_pose_with_fewer_inliers(iterations: int) -> None:
    """Random pixels of 60 in 100 points; no sample of so few has three of the others."""
    generator = torch.Generator().manual_seed(0)
    corner, size = torch.tensor([-1.0, -1, 2]).double(), torch.tensor([CAMERA.width, CAMERA.height]).double()
    points = 2 * torch.rand(100, 3, dtype=torch.float64, generator=generator) + corner
    uv = CAMERA.project(points)
    uv[:60] = torch.rand(60, 2, dtype=torch.float64, generator=generator) * size
    prediction = torch.eye(4, dtype=torch.float64)
    found = pnp_ransac(points, uv, CAMERA.K, prediction, iterations=iterations)
    assert found.inliers[60:].all() and se3_log(found.T_cw).norm() < 0.01
