"""Silhouettes of clouds: pixels near the points, and pixels whose depth agrees with the points."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.silhouette import Silhouette, silhouettes

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
WALL, OBJECT = 4.0, 2.0
CELL = 4  # pixels, resolution of silhouettes
SPACING, TOLERANCE = 0.02, 0.1
BOARD = slice(40, 80), slice(60, 100)


def points(z: float = OBJECT, every: int = 1, rows: slice = BOARD[0], columns: slice = BOARD[1]) -> Tensor:
    """Return points on a board parallel to the image, one on every n-th pixel, (P, 3)."""
    return z * CAMERA.rays[rows, columns][::every, ::every].reshape(-1, 3)


def board_and_wall(z: float = OBJECT) -> Tensor:
    """Return the depth of the board in front of the wall, (1, H, W)."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    depth[0, BOARD[0], BOARD[1]] = z
    return depth


ON_BOARD = board_and_wall()[0] == OBJECT


def draw(cloud: Tensor, depth: Tensor, spacing: float = SPACING, margin: int = 0) -> tuple[Tensor, Tensor]:
    (silhouette,) = silhouettes([cloud], CAMERA, spacing)
    return near_and_agreeing(silhouette, depth, margin)


def near_and_agreeing(
    silhouette: Silhouette, depth: Tensor, margin: int, tolerance: float = TOLERANCE
) -> tuple[Tensor, Tensor]:
    """Return the pixels near the points, and those of them whose depth agrees with the points."""
    near = silhouette.mask(torch.zeros_like(depth), margin, tolerance, include_missing=True)
    return near, silhouette.mask(depth, margin, tolerance)


@pytest.mark.parametrize("margin", [0, 8, 20])
def test_board_agrees_with_its_own_pixels_only(margin: int) -> None:
    near, agreeing = draw(points(), board_and_wall(), margin=margin)
    assert near.dtype == agreeing.dtype == torch.bool and near.shape == agreeing.shape == (120, 160)
    assert torch.equal(agreeing, ON_BOARD)
    assert (near & ~ON_BOARD).any()


@pytest.mark.parametrize("margin", [0, 4, 8, 16, 24])
def test_margin_extends_the_silhouette(margin: int) -> None:
    """Along rows and columns, to the resolution of a cell."""
    near, _ = draw(points(), board_and_wall(), margin=margin)
    assert near[ON_BOARD].all()
    reach = margin + SPACING * CAMERA.fx / OBJECT
    (middle_row,) = torch.nonzero(near[60]).T
    (middle_column,) = torch.nonzero(near[:, 80]).T
    for outside in (60 - middle_row[0], middle_row[-1] - 99, 40 - middle_column[0], middle_column[-1] - 79):
        assert abs(float(outside) - reach) <= CELL
    away = distance_transform_edt(~ON_BOARD)
    assert away[near].max() <= reach + 1.5 * CELL  # round corners


@pytest.mark.parametrize(("every", "closed"), [(8, True), (20, False)])
def test_gaps_up_to_the_spacing_are_closed(every: int, closed: bool) -> None:
    near, agreeing = draw(points(every=every), board_and_wall(), spacing=8 * OBJECT / CAMERA.fx)
    inside = (slice(41, 73), slice(61, 93))
    assert bool(near[inside].all()) is bool(agreeing[inside].all()) is closed


def test_silhouette_of_a_given_spacing_shrinks_with_distance() -> None:
    depth = board_and_wall()
    wide = [int(draw(points(z), depth, spacing=0.2)[0].sum()) for z in (1.0, 2.0, 4.0)]
    assert wide[0] > wide[1] > wide[2]


@pytest.mark.parametrize("sign", [-1, 1])
def test_depth_within_the_tolerance_agrees(sign: int) -> None:
    for off, all_of_it in ((0.95, True), (1.05, False)):
        _, agreeing = draw(points(), board_and_wall(OBJECT + sign * off * TOLERANCE))
        assert agreeing[ON_BOARD].all() if all_of_it else not agreeing.any()


def test_depth_range_is_local() -> None:
    """Two boards, one near and one far: each agrees with its own depth at its own position only."""
    left, right = points(1.5, columns=slice(20, 50)), points(3.5, columns=slice(100, 130))
    cloud = torch.cat([left, right])
    for z, columns in ((1.5, (20, 50)), (3.5, (100, 130))):
        _, agreeing = draw(cloud, torch.full((1, 120, 160), z))
        (seen,) = torch.nonzero(agreeing.any(dim=0)).T
        assert agreeing[40:80, slice(*columns)].all()
        assert columns[0] - 2 * CELL <= seen.min() and seen.max() < columns[1] + 2 * CELL


def test_depth_between_front_and_back_agrees() -> None:
    """A box at its edge has depths from front to back around one pixel."""
    cloud = torch.cat([points(1.8), points(2.4)])
    for z, within in ((1.65, False), (1.75, True), (2.1, True), (2.45, True), (2.55, False)):
        assert bool(draw(cloud, torch.full((1, 120, 160), z))[1][60, 80]) is within


def test_pixels_without_depth_are_near_but_do_not_agree() -> None:
    depth = board_and_wall()
    depth[0, 50:60, 70:80] = 0.0
    near, agreeing = draw(points(), depth)
    assert near[50:60, 70:80].all() and not agreeing[50:60, 70:80].any()


@pytest.mark.parametrize(
    "cloud",
    [torch.zeros(0, 3), -points(), points(0.05), points() + torch.tensor([50.0, 0.0, 0.0])],
    ids=["none", "behind the camera", "at the lens", "beside the image"],
)
def test_cloud_outside_of_the_image_has_an_empty_silhouette(cloud: Tensor) -> None:
    near, agreeing = draw(cloud, board_and_wall(), margin=8)
    assert near.shape == agreeing.shape == (120, 160)
    assert not near.any() and not agreeing.any()


def test_points_outside_of_the_image_do_not_change_the_silhouette() -> None:
    """Points behind the camera that project to the same pixels are ignored."""
    expected = draw(points(), board_and_wall(), margin=8)
    found = draw(torch.cat([points(), -points(), points(0.05)]), board_and_wall(), margin=8)
    assert all(map(torch.equal, found, expected))


@pytest.mark.parametrize("degrees", [25, 58, 60, 62, 75, 89])
def test_lens_distortion_does_not_fold_points_into_the_image(degrees: float) -> None:
    """The distortion polynomial maps a ray at 60 degrees into the image, which ends at 31 degrees."""
    lens = (0.039903, -0.099343, -0.000730, -0.000144, 0.0)
    camera = PinholeCamera(542.822841, 542.576870, 315.593520, 237.756098, distortion=lens)
    cloud = OBJECT * torch.tensor([[math.tan(math.radians(degrees)), 0.0, 1.0]])
    near = silhouettes([cloud], camera, SPACING)[0].mask(torch.zeros(1, 480, 640), 8, TOLERANCE, include_missing=True)
    assert bool(near.any()) is (degrees < 31)


@pytest.mark.parametrize(("height", "width"), [(120, 160), (117, 158), (5, 7)])
@settings(max_examples=25)
@given(st.integers(0, 10_000), st.integers(0, 12))
def test_each_point_is_near_and_agrees_with_its_own_depth(height: int, width: int, seed: int, margin: int) -> None:
    """With a strong lens, and with image sizes that are no multiple of a cell."""
    lens = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    camera = PinholeCamera(130.0, 130.0, width / 2, height / 2, width=width, height=height, distortion=lens)
    generator = torch.Generator().manual_seed(seed)
    pixel = torch.rand(20, 2, generator=generator, dtype=torch.float64) * torch.tensor([height - 1.0, width - 1.0])
    v, u = pixel.round().to(torch.int64).unique(dim=0).T
    z = 0.5 + 4 * torch.rand(len(v), generator=generator)
    depth = torch.zeros(1, height, width)
    depth[0, v, u] = z
    (silhouette,) = silhouettes([camera.rays[v, u] * z[:, None]], camera, SPACING)
    near, agreeing = near_and_agreeing(silhouette, depth, margin, 0.01)
    assert near[v, u].all() and agreeing[v, u].all()
    assert not (agreeing & ~near).any()


def test_silhouettes_of_several_clouds_are_independent() -> None:
    clouds = [points(), torch.zeros(0, 3), points(1.5, every=3), -points()]
    together = [
        near_and_agreeing(silhouette, board_and_wall(), 8) for silhouette in silhouettes(clouds, CAMERA, SPACING)
    ]
    for cloud, (near, agreeing) in zip(clouds, together, strict=True):
        alone = draw(cloud, board_and_wall(), margin=8)
        assert torch.equal(near, alone[0]) and torch.equal(agreeing, alone[1])


@pytest.mark.parametrize("step", [2, 3, 4, 5, 8])
def test_every_nth_pixel_equals_the_full_mask(step: int) -> None:
    depth = board_and_wall()
    depth[0, 50:60, 70:80] = 0.0
    (silhouette,) = silhouettes([points(every=3)], CAMERA, SPACING)
    for include_missing in (False, True):
        all_of_them = silhouette.mask(depth, 8, TOLERANCE, include_missing=include_missing)
        some = silhouette.mask(depth[:, ::step, ::step], 8, TOLERANCE, stride=step, include_missing=include_missing)
        assert some.any() and torch.equal(some, all_of_them[::step, ::step])


@pytest.mark.parametrize(("rows", "columns"), [((0, 120), (0, 160)), ((36, 84), (52, 108)), ((60, 120), (0, 80))])
@pytest.mark.parametrize("step", [1, 2, 4])
def test_mask_of_a_part_of_the_image_is_that_part_of_the_mask(
    rows: tuple[int, int], columns: tuple[int, int], step: int
) -> None:
    depth, part = board_and_wall(), (slice(*rows), slice(*columns))
    (silhouette,) = silhouettes([points(every=3)], CAMERA, SPACING)
    crop = slice(rows[0] // step, rows[1] // step), slice(columns[0] // step, columns[1] // step)
    found = silhouette.mask(depth[:, ::step, ::step], 8, TOLERANCE, stride=step, crop=crop)
    expected = silhouette.mask(depth, 8, TOLERANCE)[part][::step, ::step]
    assert found.any() and torch.equal(found, expected)


def test_include_missing_adds_near_pixels_without_depth() -> None:
    depth = board_and_wall()
    depth[0, 50:60, 70:80] = 0.0
    (silhouette,) = silhouettes([points()], CAMERA, SPACING)
    hole = depth[0] == 0
    assert (
        not silhouette.mask(depth, 8, TOLERANCE)[hole].any()
        and silhouette.mask(depth, 8, TOLERANCE, include_missing=True)[hole].all()
    )
    assert torch.equal(
        silhouette.mask(depth, 8, TOLERANCE) | hole, silhouette.mask(depth, 8, TOLERANCE, include_missing=True)
    )
