"""Silhouettes of clouds: which pixels are near an object's points, and whose depth the points explain."""

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
CELL = 4  # pixels, in which outlines are drawn
SPACING, TOLERANCE = 0.02, 0.1
BOARD = slice(40, 80), slice(60, 100)


def points(z: float = OBJECT, every: int = 1, rows: slice = BOARD[0], columns: slice = BOARD[1]) -> Tensor:
    """A board parallel to the image, a point on every n-th pixel, (P, 3)."""
    return z * CAMERA.rays[rows, columns][::every, ::every].reshape(-1, 3)


def before_a_wall(z: float = OBJECT) -> Tensor:
    """Depth of the board before the wall, (1, H, W)."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    depth[0, BOARD[0], BOARD[1]] = z
    return depth


ON_BOARD = before_a_wall()[0] == OBJECT


def draw(cloud: Tensor, depth: Tensor, spacing: float = SPACING, margin: int = 0) -> tuple[Tensor, Tensor]:
    (silhouette,) = silhouettes([cloud], CAMERA, spacing)
    return near_and_explained(silhouette, depth, margin)


def near_and_explained(
    silhouette: Silhouette, depth: Tensor, margin: int, tolerance: float = TOLERANCE
) -> tuple[Tensor, Tensor]:
    """Pixels near the points, which are those that are drawn where nothing is measured, and those explained."""
    near = silhouette(torch.zeros_like(depth), margin, tolerance, or_missing=True)
    return near, silhouette(depth, margin, tolerance)


@pytest.mark.parametrize("margin", [0, 8, 20])
def test_a_board_explains_its_own_pixels_and_none_of_the_wall(margin: int) -> None:
    near, explained = draw(points(), before_a_wall(), margin=margin)
    assert near.dtype == explained.dtype == torch.bool and near.shape == explained.shape == (120, 160)
    assert torch.equal(explained, ON_BOARD)
    assert (near & ~ON_BOARD).any()


@pytest.mark.parametrize("margin", [0, 4, 8, 16, 24])
def test_the_outline_is_farther_out_by_the_margin(margin: int) -> None:
    """Along rows and columns; to the cell, for it is drawn in cells."""
    near, _ = draw(points(), before_a_wall(), margin=margin)
    assert near[ON_BOARD].all()
    reach = margin + SPACING * CAMERA.fx / OBJECT
    (middle_row,) = torch.nonzero(near[60]).T
    (middle_column,) = torch.nonzero(near[:, 80]).T
    for outside in (60 - middle_row[0], middle_row[-1] - 99, 40 - middle_column[0], middle_column[-1] - 79):
        assert abs(float(outside) - reach) <= CELL
    away = distance_transform_edt(~ON_BOARD)
    assert away[near].max() <= reach + 1.5 * CELL  # round corners, no square ones


@pytest.mark.parametrize(("every", "closed"), [(8, True), (20, False)])
def test_gaps_of_the_spacing_are_closed_and_wider_ones_are_not(every: int, closed: bool) -> None:
    near, explained = draw(points(every=every), before_a_wall(), spacing=8 * OBJECT / CAMERA.fx)
    inside = (slice(41, 73), slice(61, 93))
    assert bool(near[inside].all()) is bool(explained[inside].all()) is closed


def test_a_spacing_in_metres_is_fewer_pixels_far_away() -> None:
    depth = before_a_wall()
    wide = [int(draw(points(z), depth, spacing=0.2)[0].sum()) for z in (1.0, 2.0, 4.0)]
    assert wide[0] > wide[1] > wide[2]


@pytest.mark.parametrize("sign", [-1, 1])
def test_depth_within_the_tolerance_is_explained(sign: int) -> None:
    for off, all_of_it in ((0.95, True), (1.05, False)):
        _, explained = draw(points(), before_a_wall(OBJECT + sign * off * TOLERANCE))
        assert explained[ON_BOARD].all() if all_of_it else not explained.any()


def test_each_place_has_depths_of_its_own() -> None:
    """Two boards, one near and one far: either explains its own depth at its own place, and not the other's."""
    left, right = points(1.5, columns=slice(20, 50)), points(3.5, columns=slice(100, 130))
    cloud = torch.cat([left, right])
    for z, columns in ((1.5, (20, 50)), (3.5, (100, 130))):
        _, explained = draw(cloud, torch.full((1, 120, 160), z))
        (seen,) = torch.nonzero(explained.any(dim=0)).T
        assert explained[40:80, slice(*columns)].all()
        assert columns[0] - 2 * CELL <= seen.min() and seen.max() < columns[1] + 2 * CELL


def test_between_front_and_back_all_is_explained() -> None:
    """A box seen at its edge has depths from front to back around one place."""
    cloud = torch.cat([points(1.8), points(2.4)])
    for z, within in ((1.65, False), (1.75, True), (2.1, True), (2.45, True), (2.55, False)):
        assert bool(draw(cloud, torch.full((1, 120, 160), z))[1][60, 80]) is within


def test_pixels_without_depth_are_near_and_not_explained() -> None:
    depth = before_a_wall()
    depth[0, 50:60, 70:80] = 0.0
    near, explained = draw(points(), depth)
    assert near[50:60, 70:80].all() and not explained[50:60, 70:80].any()


@pytest.mark.parametrize(
    "cloud",
    [torch.zeros(0, 3), -points(), points(0.05), points() + torch.tensor([50.0, 0.0, 0.0])],
    ids=["none", "behind the camera", "at the lens", "beside the image"],
)
def test_a_cloud_that_is_not_in_the_image_has_no_silhouette(cloud: Tensor) -> None:
    near, explained = draw(cloud, before_a_wall(), margin=8)
    assert near.shape == explained.shape == (120, 160)
    assert not near.any() and not explained.any()


def test_points_that_are_not_in_the_image_do_not_change_it() -> None:
    """Behind the camera and at the same pixels: of no consequence."""
    expected = draw(points(), before_a_wall(), margin=8)
    found = draw(torch.cat([points(), -points(), points(0.05)]), before_a_wall(), margin=8)
    assert all(map(torch.equal, found, expected))


@pytest.mark.parametrize("degrees", [25, 58, 60, 62, 75, 89])
def test_a_lens_folds_nothing_from_afar_into_the_image(degrees: float) -> None:
    """Bonn's polynomial lens maps a ray at 60 degrees to a pixel; the image ends at 31."""
    lens = (0.039903, -0.099343, -0.000730, -0.000144, 0.0)
    camera = PinholeCamera(542.822841, 542.576870, 315.593520, 237.756098, distortion=lens)
    cloud = OBJECT * torch.tensor([[math.tan(math.radians(degrees)), 0.0, 1.0]])
    near = silhouettes([cloud], camera, SPACING)[0](torch.zeros(1, 480, 640), 8, TOLERANCE, or_missing=True)
    assert bool(near.any()) is (degrees < 31)


@pytest.mark.parametrize(("height", "width"), [(120, 160), (117, 158), (5, 7)])
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 12))
def test_each_point_is_near_and_explains_its_own_depth(height: int, width: int, seed: int, margin: int) -> None:
    """With the lens of TUM's fr1, scaled; images that no cell divides too."""
    lens = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    camera = PinholeCamera(130.0, 130.0, width / 2, height / 2, width=width, height=height, distortion=lens)
    generator = torch.Generator().manual_seed(seed)
    pixel = torch.rand(20, 2, generator=generator, dtype=torch.float64) * torch.tensor([height - 1.0, width - 1.0])
    v, u = pixel.round().to(torch.int64).unique(dim=0).T
    z = 0.5 + 4 * torch.rand(len(v), generator=generator)
    depth = torch.zeros(1, height, width)
    depth[0, v, u] = z
    (silhouette,) = silhouettes([camera.rays[v, u] * z[:, None]], camera, SPACING)
    near, explained = near_and_explained(silhouette, depth, margin, 0.01)
    assert near[v, u].all() and explained[v, u].all()
    assert not (explained & ~near).any()


def test_several_clouds_are_drawn_as_each_alone() -> None:
    clouds = [points(), torch.zeros(0, 3), points(1.5, every=3), -points()]
    together = [near_and_explained(drawn, before_a_wall(), 8) for drawn in silhouettes(clouds, CAMERA, SPACING)]
    for cloud, (near, explained) in zip(clouds, together, strict=True):
        alone = draw(cloud, before_a_wall(), margin=8)
        assert torch.equal(near, alone[0]) and torch.equal(explained, alone[1])


@pytest.mark.parametrize("step", [2, 3, 4, 5, 8])
def test_every_nth_pixel_is_drawn_as_among_all(step: int) -> None:
    depth = before_a_wall()
    depth[0, 50:60, 70:80] = 0.0
    (drawn,) = silhouettes([points(every=3)], CAMERA, SPACING)
    for or_missing in (False, True):
        all_of_them = drawn(depth, 8, TOLERANCE, or_missing=or_missing)
        some = drawn(depth[:, ::step, ::step], 8, TOLERANCE, step=step, or_missing=or_missing)
        assert some.any() and torch.equal(some, all_of_them[::step, ::step])


def test_pixels_without_depth_are_taken_on_request_where_points_are_near() -> None:
    depth = before_a_wall()
    depth[0, 50:60, 70:80] = 0.0
    (drawn,) = silhouettes([points()], CAMERA, SPACING)
    hole = depth[0] == 0
    assert not drawn(depth, 8, TOLERANCE)[hole].any() and drawn(depth, 8, TOLERANCE, or_missing=True)[hole].all()
    assert torch.equal(drawn(depth, 8, TOLERANCE) | hole, drawn(depth, 8, TOLERANCE, or_missing=True))
