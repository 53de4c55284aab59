"""Dense alignment of exactly rendered planes: accuracy, and rejection of unreliable results."""

from __future__ import annotations

from dataclasses import replace

import cv2
import pytest
import torch
from helpers.library_settings import torch_threads
from helpers.rendered_planes import (
    ALL_PIXELS,
    IDENTITY,
    LENS,
    MOTION,
    PINHOLE,
    WALL,
    A,
    B,
    Image,
    Paint,
    align,
    motion_error,
    noisy,
    render,
    smooth_pattern,
    uniform,
    vertical_stripes,
)
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from torch import Tensor

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.odometry.dense_aligner import DenseAligner, DenseAlignment, align_depth
from v3d_torch.odometry.dense_view import DenseView

# ---------------------------------------------------------------------------------------------- accuracy


def test_convention_motion_maps_points_of_the_reference_to_the_current_camera() -> None:
    millimetres, degrees = motion_error(align(A, B), MOTION)
    assert millimetres < 0.5
    assert degrees < 0.02


def test_lens_distortion_is_modelled() -> None:
    assert motion_error(align(A, B), MOTION)[0] < 0.2 * motion_error(align(A, B, camera=PINHOLE), MOTION)[0]


@pytest.mark.parametrize(("yaw", "roll"), [(0.0, 0.0), (0.15, 0.15), (0.0, 2.5)])
def test_alignment_converges_from_a_prediction_of_a_large_motion(yaw: float, roll: float) -> None:
    T_ba = se3_exp(torch.tensor([0.1, 0.0, 0.1, 0.0, yaw, roll], dtype=torch.float64))
    predicted = se3_exp(torch.tensor([0.01, 0.0, 0.01, 0.02, 0.02, -0.04], dtype=torch.float64)) @ T_ba
    millimetres, degrees = motion_error(align(A, render(T_ba), predicted), T_ba)
    assert millimetres < 1.0
    assert degrees < 0.03


def test_alignment_with_sensor_noise() -> None:
    millimetres, degrees = motion_error(align(noisy(A), noisy(B, seed=1)), MOTION)
    assert millimetres < 2.0
    assert degrees < 0.05


@pytest.mark.parametrize(("gain", "bias"), [(1.5, 0.0), (0.5, 0.3), (0.1, 0.0)])
def test_alignment_with_changed_exposure(gain: float, bias: float) -> None:
    millimetres, degrees = motion_error(align(A, (gain * B[0] + bias, B[1])), MOTION)
    assert millimetres < 0.5
    assert degrees < 0.02


def test_missing_and_invalid_pixels_are_ignored() -> None:
    """Holes in both depth images, and rows or columns of NaN, infinity and negative depth."""
    grey_a, depth_a, grey_b, depth_b = (image.clone() for image in (*A, *B))
    depth_a[:, 100:200], depth_b[:, :, :250] = 0.0, 0.0
    depth_a[:, :, 40], depth_b[:, 300] = torch.nan, torch.inf
    grey_a[:, 50], depth_b[:, 310:320] = torch.nan, -1.0
    millimetres, degrees = motion_error(align((grey_a, depth_a), (grey_b, depth_b)), MOTION)
    assert millimetres < 1.0
    assert degrees < 0.03


def add_walker(image: Image, shift: int) -> tuple[Image, Tensor]:
    """Image with a textured object in front of the scene, 220 pixels wide, and its mask of static pixels."""
    generator = torch.Generator().manual_seed(5)
    texture = cv2.GaussianBlur(torch.rand(480, 220, generator=generator).numpy(), (0, 0), 4)
    grey, depth = image[0].clone(), image[1].clone()
    grey[0, :, shift : shift + 220] = torch.from_numpy((texture - texture.mean()) * 6 + 0.5)
    depth[0, :, shift : shift + 220] = 1.0
    static = ALL_PIXELS.clone()
    static[:, shift - 4 : shift + 224] = False
    return (grey, depth), static


def test_masked_objects_do_not_bias_the_motion_and_unmasked_ones_do() -> None:
    (a, static_a), (b, static_b) = add_walker(A, 200), add_walker(B, 215)
    masked = motion_error(align(a, b, static=(static_a, static_b)), MOTION)
    assert masked[0] < 1.0 and masked[1] < 0.03
    # One mask is enough: in the other view the object differs in depth from the scene and counts as an occlusion.
    for static in ((static_a, ALL_PIXELS), (ALL_PIXELS, static_b)):
        assert motion_error(align(a, b, static=static), MOTION)[0] < 3.0
    unmasked = align(a, b)
    assert unmasked is None or motion_error(unmasked, MOTION)[0] > 5 * masked[0]


def test_alignment_is_deterministic_for_any_number_of_threads() -> None:
    a, b = noisy(A), noisy(B, seed=1)
    aligner = DenseAligner(DenseOdometryConfig(halvings=(4, 1), iterations=2), LENS)

    def run() -> DenseAlignment | None:
        return aligner.align_views(aligner.view(*a, ALL_PIXELS), aligner.view(*b, ALL_PIXELS), MOTION)

    first, second = run(), run()
    with torch_threads(2):
        third = run()
    for other in (second, third):
        assert first is not None and other is not None
        assert torch.equal(first.T_ba, other.T_ba)
        assert torch.equal(first.information, other.information)
        assert first._replace(T_ba=0, information=0) == other._replace(T_ba=0, information=0)


def test_information_is_that_of_errors_in_the_current_camera() -> None:
    """Motion along the stripes of a wall is unobservable; they have another direction for a camera that is rolled."""
    roll = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, torch.pi / 4], dtype=torch.float64))
    a, b = (render(T_cw, planes=WALL, paint=vertical_stripes) for T_cw in (IDENTITY, roll))
    information = align_depth(*a, *b, LENS, roll, config=DenseOdometryConfig(halvings=(3,))).information[:3, :3]
    across, along, _ = roll[:3, :3].T
    assert (along @ information @ along).abs() < 1e-2 * (across @ information @ across)


def test_occluded_points_are_no_inliers() -> None:
    b, _ = add_walker(A, 200)
    found = align_depth(*A, *b, LENS, config=DenseOdometryConfig(halvings=(2,)))
    assert float(found.inlier_ratio) == pytest.approx(1 - 220 / 640, abs=0.01)


# ---------------------------------------------------------------------------------------------- rejection


BLACK = torch.zeros(1, 480, 640)
NO_PIXELS = ~ALL_PIXELS
NO_OVERLAP = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 1.5, 0.0], dtype=torch.float64))
NAN_POSE = torch.full((4, 4), torch.nan, dtype=torch.float64)


@pytest.mark.parametrize(
    ("a", "b", "T_ba"),
    [
        pytest.param((BLACK, A[1]), (BLACK, B[1]), IDENTITY, id="both black"),
        pytest.param(A, (BLACK, B[1]), IDENTITY, id="current black"),
        pytest.param((BLACK, A[1]), B, IDENTITY, id="reference black"),
        pytest.param((A[0], BLACK), B, IDENTITY, id="reference without depth"),
        pytest.param(A, (B[0], BLACK), IDENTITY, id="current without depth"),
        pytest.param((A[0] * torch.nan, A[1]), B, IDENTITY, id="grey not a number"),
        pytest.param((A[0], A[1] * torch.nan), (B[0], B[1] * torch.inf), IDENTITY, id="depth not a number"),
        pytest.param(A, B, NO_OVERLAP, id="no overlap"),
        pytest.param(A, B, NAN_POSE, id="prediction not a number"),
        pytest.param(A, (B[0].flip(1), B[1]), IDENTITY, id="another picture"),
        pytest.param(A, (B[0], B[1] * 1.5), IDENTITY, id="another depth"),
    ],
)
def test_unusable_views_give_none(a: Image, b: Image, T_ba: Tensor) -> None:
    assert align(A, B) is not None
    assert align(a, b, T_ba) is None


def test_views_without_static_pixels_give_none() -> None:
    corner = NO_PIXELS.clone()
    corner[:20, :20] = True
    for static in ((NO_PIXELS, ALL_PIXELS), (ALL_PIXELS, NO_PIXELS), (corner, ALL_PIXELS), (ALL_PIXELS, corner)):
        assert align(A, B, static=static) is None


def test_too_little_overlap_gives_none() -> None:
    """A fifth of the view overlaps and fits; the threshold of observability is lowered so that it does not matter."""
    T_ba = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.85, 0.0], dtype=torch.float64))
    b = render(T_ba)
    for min_overlap, accepted in ((0.3, False), (0.1, True)):
        aligner = DenseAligner(DenseOdometryConfig(min_overlap=min_overlap, min_observability=1e-6), LENS)
        alignment = aligner.align_views(aligner.view(*A, ALL_PIXELS), aligner.view(*b, ALL_PIXELS), T_ba)
        assert (alignment is not None) is accepted


def test_inconsistent_brightness_gives_none() -> None:
    """A third of the image has another texture on the same surfaces."""
    grey = B[0].clone()
    grey[:, :, :200] = B[0].flip(1)[:, :, :200]
    assert align(A, (grey, B[1])) is None


@pytest.mark.parametrize("paint", [uniform, vertical_stripes])
@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.04])
def test_unobservable_motion_along_a_wall_gives_none(paint: Paint, sigma: float) -> None:
    sideways = se3_exp(torch.tensor([0.01, 0.03, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    for pattern, accepted in ((paint, False), (smooth_pattern, True)):
        a, b = (noisy(render(T, planes=WALL, paint=pattern), sigma, k) for k, T in enumerate((IDENTITY, sideways)))
        assert (align(a, b) is not None) is accepted


@given(st.integers(0, 2**31))
def test_random_images_with_invalid_values_give_none(seed: int) -> None:
    """Noise with holes, NaN and infinity, on a camera of odd size."""
    generator = torch.Generator().manual_seed(seed)
    camera = replace(LENS, width=67, height=49, cx=33.0, cy=24.0)
    aligner = DenseAligner(DenseOdometryConfig(), camera)

    def view() -> DenseView:
        grey, depth = torch.rand(2, 1, 49, 67, generator=generator)
        special = torch.tensor([0.0, torch.nan, torch.inf, -torch.inf, -1.0, 1e-30, 1e30])
        for image in (grey, 8 * depth):
            where = torch.rand(image.shape, generator=generator) < 0.3
            image[where] = special[torch.randint(0, 7, (int(where.sum()),), generator=generator)]
        return aligner.view(grey, depth, torch.rand(49, 67, generator=generator) < 0.9)

    T_ba = se3_exp(3 * torch.randn(6, generator=generator, dtype=torch.float64))
    assert aligner.align_views(view(), view(), T_ba) is None


# ---------------------------------------------------------------------------------------------- batches


def test_pairs_of_a_batch_are_aligned_as_alone() -> None:
    """One pair is black, one has masks, and one a prediction."""
    greys_a, depths_a = (torch.stack([each, each * scale, each]) for each, scale in zip(A, (0, 1), strict=True))
    greys_b, depths_b = (torch.stack([each] * 3) for each in B)
    masks = ALL_PIXELS.repeat(3, 1, 1)
    masks[2, :, :100] = False
    motions = torch.stack([MOTION, IDENTITY, IDENTITY])
    config = DenseOdometryConfig(halvings=(4, 3, 2))
    found = align_depth(greys_a, depths_a, greys_b, depths_b, LENS, motions, static_a=masks, config=config)
    assert found.reliable.tolist() == [True, False, True]
    assert found.T_ba.shape == (3, 4, 4) and found.information.shape == (3, 6, 6) and found.overlap.shape == (3,)
    assert found.T_ba[1].isnan().all()
    aligner = DenseAligner(config, LENS)
    for k in (0, 2):
        alone = aligner.align_views(aligner.view(*A, masks[k]), aligner.view(*B, ALL_PIXELS), motions[k])
        assert alone is not None
        for one, other in zip(found, alone, strict=True):
            assert torch.equal(one[k], other)
    assert align_depth(greys_a[:0], depths_a[:0], greys_b[:0], depths_b[:0], LENS).T_ba.shape == (0, 4, 4)


@pytest.mark.parametrize("name", ["T_ba", "static_a", "static_b"])
def test_only_the_prediction_or_a_mask_can_have_batch_dimensions(name: str) -> None:
    masks = ALL_PIXELS.repeat(2, 1, 1)
    masks[0, :, :100] = False
    several = torch.stack([MOTION, IDENTITY]) if name == "T_ba" else masks
    config = DenseOdometryConfig(halvings=(4, 3, 2))
    found = align_depth(*A, *B, LENS, **{name: several[:, None]}, config=config)
    assert found.T_ba.shape == (2, 1, 4, 4) and found.reliable.all()
    for k in range(2):
        alone = align_depth(*A, *B, LENS, **{name: several[k]}, config=config)
        for one, other in zip(found, alone, strict=True):
            assert torch.equal(one[k, 0], other)


@pytest.mark.parametrize("name", ["T_ba", "static_a", "static_b"])
def test_predictions_and_masks_of_another_shape_are_rejected(name: str) -> None:
    for shape in ((3, 3), (4,)) if name == "T_ba" else ((1, 1), (480, 1), (640,)):
        given = torch.ones(shape, dtype=torch.float64 if name == "T_ba" else torch.bool)
        with pytest.raises(ShapeError):
            align_depth(*A, *B, LENS, **{name: given})


def test_images_without_a_batch_dimension_are_aligned() -> None:
    found = align_depth(*A, *B, LENS)
    assert found.T_ba.shape == (4, 4) and bool(found.reliable)
    assert motion_error(found, MOTION)[0] < 1.0


@pytest.mark.parametrize("size", [(1280, 960), (320, 240)])
def test_images_of_another_size_than_the_camera_are_rejected(size: tuple[int, int]) -> None:
    camera = replace(LENS, width=size[0], height=size[1])
    with pytest.raises(InputError, match=f"the camera {size[0]} x {size[1]}; give a camera"):
        align_depth(*A, *B, camera)


def test_images_of_one_row_are_rejected() -> None:
    row, camera = torch.rand(1, 1, 32), replace(LENS, width=32, height=1)
    with pytest.raises(InputError, match=r"^images of 32 x 1 pixels .* at least 2 rows and 2 columns$"):
        align_depth(row, row, row, row, camera)
