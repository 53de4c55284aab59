"""Free-space check: vacated points, pixels that appeared, and unknown ones."""

from __future__ import annotations

import gc
import math
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import minimum_filter
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.packed_masks import pack_masks
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects import image_scale
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.free_space_check import (
    DepthView,
    FreeSpaceCheck,
    observe_free_space,
    vacated_fractions,
)

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
CONFIG = FreeSpaceConfig()
WALL, OBJECT = 4.0, 2.0
RIM = 2  # 1 % of 160 pixels: this near to something at its depth or before it, a position is not free
HERE = torch.eye(4, dtype=torch.float64)
TWISTS = st.tuples(*[st.floats(-2.0, 2.0)] * 3, *[st.floats(-1.5, 1.5)] * 3)


@pytest.fixture(autouse=True)
def every_fourth_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check every 4th pixel, as with a camera of the usual size."""
    monkeypatch.setattr(image_scale, "_COARSE_STRIDE", 4 * 640 // CAMERA.width)


def surface(columns: tuple[int, int], rows: tuple[int, int] = (40, 80), z: float = OBJECT) -> Tensor:
    """Return points of a board parallel to the image, one per pixel, (P, 3); columns and rows are half-open."""
    return z * CAMERA.rays[rows[0] : rows[1], columns[0] : columns[1]].reshape(-1, 3)


def view(*boards: tuple[tuple[int, int], float], wall: float = WALL, T_wc: Tensor = HERE, at: float = 0.0) -> DepthView:
    """Return a view of boards, each (columns, depth), in front of a wall; later boards cover earlier ones."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), wall)
    for (left, right), z in boards:
        depth[0, 40:80, left:right] = z
    return DepthView(at, depth, invert(T_wc))


def vacated_fraction(cloud: Tensor, observed: DepthView, **config: float) -> float:
    return float(vacated_fractions([cloud], observed, CAMERA, FreeSpaceConfig(**config))[0])


# ---------------------------------------------------------------- vacated points


@pytest.mark.parametrize(("height", "width", "side"), [(120, 160, 5), (48, 64, 3), (20, 30, 1), (480, 640, 13)])
def test_nearest_depth_is_the_minimum_measured_depth_around(height: int, width: int, side: int) -> None:
    depth = torch.rand(1, height, width, generator=torch.Generator().manual_seed(0)) + 0.5
    depth[depth < 0.7] = 0.0
    measured = np.where(depth[0] > 0, depth[0], np.inf)
    expected = np.where(depth[0] > 0, minimum_filter(measured, side, mode="constant", cval=np.inf), 0.0)
    assert torch.equal(DepthView(0.0, depth, HERE).nearest_depth, torch.from_numpy(expected.astype(np.float32)))


def turned(degrees: float) -> Tensor:
    """Return the world-to-camera pose of a camera that is turned to the right."""
    return se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, -math.radians(degrees), 0.0], dtype=torch.float64))


def test_misalignment_grows_with_the_rotation_rate() -> None:
    """3 degrees in 0.1 s are 0.6 degrees in the 0.02 s between colour and depth, times the focal length in pixels."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    check = FreeSpaceCheck(FreeSpaceConfig(depth_sync_error=0.02), CAMERA)
    assert check.make_view(0.0, depth, HERE).misalignment == 0  # no earlier view
    check.add_view(view(), invert(HERE))
    assert check.make_view(0.1, depth, HERE).misalignment == 0
    assert check.make_view(0.1, depth, turned(3.0)).misalignment == round(math.radians(0.6) * CAMERA.fx)
    assert check.make_view(0.1, depth, turned(60.0)).misalignment == round(math.radians(12.0) * CAMERA.fx)
    assert (
        FreeSpaceCheck(FreeSpaceConfig(depth_sync_error=0.0), CAMERA).make_view(0.1, depth, turned(60.0)).misalignment
        == 0
    )
    moved = torch.eye(4, dtype=torch.float64)
    moved[0, 3] = 0.5
    assert check.make_view(0.1, depth, moved).misalignment == 0


@pytest.mark.parametrize(("misalignment", "expected"), [(0, 1.0), (6, 0.0)])
def test_misaligned_pixels_beside_a_surface_are_not_free(misalignment: int, expected: float) -> None:
    """The box is 5 pixels beside the points, within the misalignment of its depth: nothing is vacated."""
    observed = replace(view(((65, 85), OBJECT)), misalignment=misalignment)
    assert vacated_fraction(surface((57, 63)), observed) == expected


@pytest.mark.parametrize("step", [0, 1, 2, 3, 5, 10, 20, 22, 30])
def test_vacated_fraction_is_the_uncovered_part_without_the_rim(step: int) -> None:
    expected = min(max(step - RIM, 0), 20) / 20
    assert vacated_fraction(surface((60, 80)), view(((60 + step, 80 + step), OBJECT))) == pytest.approx(expected)


def test_hidden_points_are_unknown() -> None:
    """Of 20 columns 3 are free, 5 are occupied or beside something occupied, and 12 are hidden or at a rim."""
    observed = view(((65, 80), OBJECT), ((70, 80), 1.0))
    known = observe_free_space(surface((60, 80)).double(), observed, CAMERA, CONFIG).reshape(40, 20)
    expected = torch.tensor([1.0] * 3 + [0.0] * 5 + [torch.nan] * 12, dtype=torch.float64).expand(40, 20)
    torch.testing.assert_close(known, expected, rtol=0, atol=0, equal_nan=True)
    assert vacated_fraction(surface((60, 80)), observed) == pytest.approx(3 / 8)


def test_fully_occluded_object_is_unknown() -> None:
    assert math.isnan(vacated_fraction(surface((60, 80)), view(((50, 90), 1.0))))


def test_points_outside_of_the_image_are_unknown() -> None:
    """The camera has moved right by 60 pixels: the left half of the board is invisible, 3 of 10 columns are vacated."""
    T_wc = HERE.clone()
    T_wc[0, 3] = 60 * OBJECT / CAMERA.fx
    observed = view(((0, 5), OBJECT), T_wc=T_wc)
    assert vacated_fraction(surface((50, 70)), observed) == pytest.approx(0.3)


def test_points_at_the_image_border_are_known() -> None:
    for columns, rows in (((150, 160), (40, 80)), ((0, 10), (40, 80)), ((60, 80), (110, 120)), ((60, 80), (0, 10))):
        assert vacated_fraction(surface(columns, rows), view()) == 1.0


def test_points_behind_the_camera_are_unknown() -> None:
    T_wc = HERE.clone()
    T_wc[2, 3] = OBJECT + 1.0
    assert math.isnan(vacated_fraction(surface((60, 80)), view(T_wc=T_wc)))


def test_points_nearer_than_min_depth_are_unknown() -> None:
    near = surface((60, 80), z=0.29)
    assert math.isnan(vacated_fraction(near, view()))
    assert vacated_fraction(near, view(), min_depth=0.2) == 1.0


def test_pixels_without_depth_are_unknown() -> None:
    observed = view(((60, 80), OBJECT))
    observed.depth[0, 40:80, 60:70] = 0.0
    observed.depth[0, 40:80, 70:75] = WALL
    assert vacated_fraction(surface((60, 80)), observed) == pytest.approx((5 - RIM) / 10)


@pytest.mark.parametrize(("points", "known"), [(29, False), (30, True)])
def test_fraction_needs_min_points(points: int, known: bool) -> None:
    assert math.isnan(vacated_fraction(surface((60, 80))[:points], view())) is not known


def test_empty_cloud_is_unknown() -> None:
    assert math.isnan(vacated_fraction(torch.zeros(0, 3), view()))


@pytest.mark.parametrize(
    ("z", "behind", "vacated"),
    [
        (1.0, 0.039, 0.0),  # within the minimum tolerance of 4 cm
        (1.0, 0.041, 1.0),
        (3.0, 0.089, 0.0),  # within 1 cm times 3 squared
        (3.0, 0.091, 1.0),
    ],
)
def test_tolerance_grows_with_the_square_of_depth_above_a_minimum(z: float, behind: float, vacated: float) -> None:
    assert vacated_fraction(surface((60, 80), z=z), view(wall=z + behind)) == vacated


@pytest.mark.parametrize("z", [1.0, 3.0])
def test_tolerance_is_the_same_towards_the_camera(z: float) -> None:
    """A depth slightly nearer than expected is the point itself; a much nearer depth hides the point."""
    tolerance = max(0.04, 0.01 * z * z)
    assert vacated_fraction(surface((60, 80), z=z), view(wall=z - 0.9 * tolerance)) == 0.0
    assert math.isnan(vacated_fraction(surface((60, 80), z=z), view(wall=z - 1.1 * tolerance)))


def test_reappearing_object_has_vacated_nothing() -> None:
    """The old position is hidden, the new one was visible: the two views give different evidence."""
    screen = ((50, 90), 1.0)
    assert math.isnan(vacated_fraction(surface((60, 80)), view(screen, ((100, 120), OBJECT))))
    assert vacated_fraction(surface((100, 120)), view(screen)) == 1.0


def test_object_cut_by_the_image_border_has_vacated_nothing() -> None:
    """The camera passes a static board that leaves the image: its centroid moves, its points do not."""
    T_wc = HERE.clone()
    T_wc[0, 3] = -15 * OBJECT / CAMERA.fx  # to the left: the board leaves the image at the right border
    assert vacated_fraction(surface((130, 160)), view(((145, 160), OBJECT), T_wc=T_wc)) == 0.0


def test_static_object_behind_a_passing_one_has_vacated_nothing() -> None:
    covered = view(((60, 80), OBJECT), ((55, 72), 1.2))
    assert vacated_fraction(surface((60, 80)), covered) == 0.0


@settings(max_examples=50)
@given(TWISTS, st.integers(RIM, 20))
def test_vacated_fraction_does_not_depend_on_the_world_frame(xi: tuple[float, ...], step: int) -> None:
    """The depth is chosen so that float32 rounding changes no pixel and no comparison."""
    T_new_old = se3_exp(torch.tensor(xi, dtype=torch.float64))
    cloud = surface((60, 80)).double()
    moved = cloud @ T_new_old[:3, :3].T + T_new_old[:3, 3]
    observed = view(((60 + step, 80 + step), OBJECT), T_wc=T_new_old)
    assert vacated_fraction(moved.float(), observed) == pytest.approx((step - RIM) / 20)


@pytest.mark.parametrize("pixel", [(20, 30), (20, 610), (450, 30), (460, 620), (240, 320)])
def test_points_are_projected_with_lens_distortion(pixel: tuple[int, int]) -> None:
    """A strong lens distortion. A wall behind a near surface with a hole: a single pixel is free."""
    camera = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    v, u = pixel
    depth = torch.full((1, 480, 640), 1.0)
    depth[0, v - 6 : v + 7, u - 6 : u + 7] = WALL
    around = OBJECT * camera.rays[v - 1 : v + 2, u - 1 : u + 2].double().reshape(9, 3)
    known = observe_free_space(around, DepthView(0.0, depth, HERE), camera, CONFIG)
    assert known[4] == 1.0 and known.isnan().sum() == 8


@pytest.mark.parametrize("degrees", [30, 35, 45, 58, 60, 62, 75, 89])
def test_lens_distortion_does_not_fold_points_into_the_image(degrees: float) -> None:
    """The distortion polynomial maps a ray at 60 degrees into the image, which ends at 31 degrees."""
    lens = (0.039903, -0.099343, -0.000730, -0.000144, 0.0)
    camera = PinholeCamera(542.822841, 542.576870, 315.593520, 237.756098, distortion=lens)
    aside = math.tan(math.radians(degrees))
    points = OBJECT * torch.tensor([[aside, 0.0, 1.0], [-aside, 0.0, 1.0], [0.0, aside, 1.0]], dtype=torch.float64)
    known = observe_free_space(points, DepthView(0.0, torch.full((1, 480, 640), WALL), HERE), camera, CONFIG)
    assert known.isnan().tolist() == [degrees > 30.5, degrees > 30.5, True]


def test_static_slanted_floor_is_not_vacated() -> None:
    """A static floor in views from two poses, parallel to neither image, with no pixel at the same point."""
    tilted = se3_exp(torch.tensor([0.0, 0.0, 0.0, -0.5, 0.0, 0.0], dtype=torch.float64))
    turned = se3_exp(torch.tensor([0.3, -0.1, 0.2, -0.45, 0.15, 0.1], dtype=torch.float64))
    clouds, views = [], []
    for T_wc in (tilted, turned):
        direction = CAMERA.rays.double() @ T_wc[:3, :3].T
        z = (1.2 - T_wc[1, 3]) / direction[..., 1]  # the floor is 1.2 m below the origin
        depth = torch.where((z > 0) & (z < 5.0), z, 0.0)
        views.append(DepthView(0.0, depth[None].float(), invert(T_wc)))
        clouds.append((direction * depth[..., None] + T_wc[:3, 3])[depth > 0].float())
    assert float(((clouds[0][:, 1] - 1.2).abs()).max()) < 1e-5
    assert vacated_fraction(clouds[0], views[1]) < 0.001
    assert vacated_fraction(clouds[1], views[0]) < 0.001


def test_vacated_fractions_of_several_clouds_are_independent() -> None:
    clouds = [surface((60, 80)), torch.zeros(0, 3), surface((50, 70)), surface((0, 20))]
    observed = view(((65, 85), OBJECT))
    together = vacated_fractions(clouds, observed, CAMERA, CONFIG)
    torch.testing.assert_close(
        together.tolist(), [vacated_fraction(cloud, observed) for cloud in clouds], equal_nan=True
    )
    assert vacated_fractions([], observed, CAMERA, CONFIG).shape == (0,)


# ---------------------------------------------------------------- pixels that appeared

BOX = 10, 20, 15, 25
"""Rows and columns of the box in `AppearedPixels`: rows 40 to 80, columns 60 to 100 of the image."""
WITH_BOX = ((60, 100), OBJECT)


def check_with(*views: DepthView, **config: object) -> FreeSpaceCheck:
    """Return a free-space check with stored views."""
    check = FreeSpaceCheck(FreeSpaceConfig(**config), CAMERA)
    for observed in views:
        check.add_view(observed, observed.T_dw)
    return check


def box(appeared: Tensor) -> Tensor:
    top, bottom, left, right = BOX
    return appeared[..., top:bottom, left:right]


def around(appeared: Tensor) -> Tensor:
    """Return all pixels except those of the box and beside it."""
    top, bottom, left, right = BOX
    outside = torch.ones(appeared.shape[-2:], dtype=torch.bool)
    outside[top - 1 : bottom + 1, left - 1 : right + 1] = False
    return appeared[..., outside]


def room(T_wc: Tensor, *, with_box: bool, at: float) -> DepthView:
    """Return a view of a wall at z = 4 m and a box of 0.6 x 0.6 m at 2 m from any camera pose."""
    direction = CAMERA.rays.double() @ T_wc[:3, :3].T
    hit = T_wc[:3, 3] + direction * ((OBJECT - T_wc[2, 3]) / direction[..., 2])[..., None]
    on_box = with_box & (hit[..., :2].abs() < 0.3).all(dim=-1)
    depth = (torch.where(on_box, OBJECT, WALL) - T_wc[2, 3]) / direction[..., 2]
    return DepthView(at, depth[None].float(), invert(T_wc))


def test_new_box_has_appeared_and_the_wall_has_not() -> None:
    appeared = check_with(view(at=0.0))(view(WITH_BOX, at=0.3)).was_free
    assert appeared.shape == (2, 30, 40) and appeared.dtype == torch.float64
    assert (box(appeared[0]) == 1).all()
    assert (around(appeared[0]) == 0).all()
    assert appeared[1].isnan().all()  # no view from 0.9 s ago


def test_static_box_has_not_appeared() -> None:
    """At the rim of the box the wall was hidden, and its pixels are unknown."""
    appeared = check_with(view(WITH_BOX, at=0.0))(view(WITH_BOX, at=0.9)).was_free
    assert (box(appeared) == 0).all() and (around(appeared) == 0).all()
    assert not (appeared == 1).any()


def test_uncovered_wall_is_unknown() -> None:
    """The wall behind the box was hidden, so its pixels are unknown."""
    appeared = check_with(view(WITH_BOX, at=0.0))(view(at=0.3)).was_free[0]
    assert box(appeared).isnan().all()
    assert (around(appeared) == 0).all()


def test_box_uncovered_by_a_screen_is_unknown() -> None:
    appeared = check_with(view(((50, 110), 1.0), at=0.0))(view(WITH_BOX, at=0.3)).was_free[0]
    assert box(appeared).isnan().all()


def test_pixels_outside_of_the_earlier_view_are_unknown() -> None:
    turned = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, math.pi / 2, 0.0], dtype=torch.float64))
    assert check_with(view(at=0.0, T_wc=turned))(view(WITH_BOX, at=0.3)).was_free.isnan().all()


def test_pixels_without_earlier_depth_are_unknown() -> None:
    assert check_with(view(wall=0.0, at=0.0))(view(WITH_BOX, at=0.3)).was_free.isnan().all()


@pytest.mark.parametrize(("z", "known"), [(0.0, False), (0.29, False), (0.31, True), (2.9, True), (3.1, False)])
def test_pixels_outside_of_the_depth_range_are_unknown(z: float, known: bool) -> None:
    appeared = check_with(view(at=0.0), max_depth=3.0)(view(((60, 100), z), at=0.3)).was_free[0]
    assert (~box(appeared).isnan()).all() if known else box(appeared).isnan().all()
    assert around(appeared).isnan().all()  # the wall is beyond the maximum depth


def test_all_pixels_are_unknown_without_stored_views() -> None:
    assert check_with()(view(WITH_BOX)).was_free.isnan().all()


def test_view_is_not_compared_with_itself() -> None:
    observed = view(WITH_BOX, at=0.0)
    assert check_with(observed)(observed).was_free.isnan().all()


def test_disabled_check_compares_nothing() -> None:
    appeared_pixels = check_with(view(at=0.0), enabled=False)(view(WITH_BOX, at=0.9))
    assert appeared_pixels.was_free.shape == (0, 30, 40)
    assert appeared_pixels.fractions([pack_masks(torch.ones(30, 40, dtype=torch.bool))], [1], [False]).shape == (1, 0)


def test_view_with_guessed_pose_is_not_compared() -> None:
    check, current = check_with(view(at=0.0)), view(WITH_BOX, at=0.9)
    assert check(current, pose_known=False).was_free.numel() == 0
    assert check(current).was_free.shape[0] == 2


def test_dropped_views_are_not_compared() -> None:
    check, current = check_with(view(at=0.0)), view(WITH_BOX, at=0.9)
    assert not check(current).was_free.isnan().all()
    check.drop_views()
    assert check(current).was_free.isnan().all()


@pytest.mark.parametrize("rate", [5, 10, 30])
def test_box_has_appeared_over_each_time_span(rate: int) -> None:
    """The box appears at 2 s, and has appeared over each time span for as long as it."""
    check = check_with()
    steps = {time_span: -(-round(time_span * 1000) * rate // 1000) for time_span in (0.3, 0.9)}  # whole frames
    for frame in range(4 * rate):
        current = view(*[WITH_BOX] * (frame >= 2 * rate), at=frame / rate)
        appeared = check(current).was_free
        for row, time_span in zip(appeared, (0.3, 0.9), strict=True):
            expected = 2 * rate <= frame < 2 * rate + steps[time_span]
            if frame < steps[time_span]:
                assert row.isnan().all()
            else:
                assert (box(row) == expected).all() and (around(row) == 0).all()
        check.add_view(current, current.T_dw)


def test_view_is_compared_with_the_newest_one_that_is_older_by_the_time_span() -> None:
    """Stamps of the same time differ by rounding; a view that is half a frame too new is not meant."""
    old = 0.1 + 0.2
    assert old > 0.6 - 0.3
    appeared = check_with(view(at=old), view(WITH_BOX, at=old + 0.015))(view(WITH_BOX, at=0.6)).was_free[0]
    assert (box(appeared) == 1).all()


def test_views_older_than_the_longest_time_span_are_dropped() -> None:
    check, stored, images = check_with(), [], []
    for frame in range(100):
        observed = view(at=frame / 10)
        check.add_view(observed, observed.T_dw)
        stored.append(weakref.ref(observed.nearest_depth))
        images.append(weakref.ref(observed.depth))
    del observed
    gc.collect()
    assert 10 <= sum(ref() is not None for ref in stored) <= 13
    assert all(ref() is None for ref in images)


MOVES = [(0.3, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.5, 0.0, 0.0, 0.0), (0.1, -0.1, 0.2, 0.05, -0.1, 0.1)]


@pytest.mark.parametrize("twist", MOVES)
def test_nothing_appears_in_a_static_room_under_camera_motion(twist: tuple[float, ...]) -> None:
    T_wc = se3_exp(torch.tensor(twist, dtype=torch.float64))
    for previous, current in ((HERE, T_wc), (T_wc, HERE)):
        appeared = check_with(room(previous, with_box=True, at=0.0))(room(current, with_box=True, at=0.3)).was_free[0]
        assert not (appeared == 1).any()
        assert (appeared == 0).double().mean() > 0.6


@pytest.mark.parametrize("twist", MOVES)
def test_new_box_appears_under_camera_motion(twist: tuple[float, ...]) -> None:
    T_wc = se3_exp(torch.tensor(twist, dtype=torch.float64))
    current = room(T_wc, with_box=True, at=0.3)
    appeared = check_with(room(HERE, with_box=False, at=0.0))(current).was_free[0]
    on_box = current.depth[0, ::4, ::4] < 3.0
    assert on_box.sum() > 80
    assert torch.equal(appeared == 1, on_box)


@settings(max_examples=20)
@given(TWISTS)
def test_world_correction_moves_the_stored_views(twist: tuple[float, ...]) -> None:
    """A loop correction moves the map and the camera: the pixels that appeared stay the same."""
    T_new_old = se3_exp(torch.tensor(twist, dtype=torch.float64))
    check = check_with(view(at=0.0), view(WITH_BOX, at=0.6))
    expected = check(view(WITH_BOX, at=0.9)).was_free
    assert (box(expected[0]) == 0).all() and (box(expected[1]) == 1).all()
    check.apply_world_correction(T_new_old)
    appeared = check(view(WITH_BOX, at=0.9, T_wc=T_new_old)).was_free
    torch.testing.assert_close(appeared, expected, rtol=0, atol=0, equal_nan=True)


# ---------------------------------------------------------------- fractions of objects


@settings(max_examples=50)
@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(1, 5), st.integers(1, 40))
def test_fraction_of_an_object_is_that_of_its_known_or_of_all_its_pixels(
    seed: int, rows: int, stride: int, min_pixels: int
) -> None:
    rng = np.random.default_rng(seed)
    appeared = rng.choice([0.0, 1.0, np.nan], (rows, 7, 9), p=[0.3, 0.2, 0.5])
    masks = [rng.random((7 * stride, 9 * stride)) < rng.random() for _ in range(3)]
    of_all = [bool(rng.random() < 0.5) for _ in masks]
    fractions = AppearedPixels(torch.from_numpy(appeared), stride).fractions(
        [pack_masks(torch.from_numpy(mask), stride) for mask in masks], 3 * [min_pixels], of_all
    )
    assert fractions.dtype == torch.float64 and fractions.shape == (3, rows)
    for row, mask, whole in zip(fractions, masks, of_all, strict=True):
        within = [[appeared[b, v, u] for v, u in np.ndindex(7, 9) if mask[v * stride, u * stride]] for b in range(rows)]
        known = [[value for value in values if not math.isnan(value)] for values in within]
        totals = [len(all_) if whole else len(values) for all_, values in zip(within, known, strict=True)]
        expected = [
            sum(values) / total if len(values) >= min_pixels else math.nan
            for values, total in zip(known, totals, strict=True)
        ]
        torch.testing.assert_close(row, torch.tensor(expected).double(), equal_nan=True, rtol=1e-6, atol=0)


def test_fraction_of_half_a_box_is_one_half() -> None:
    """The mask covers the box that appeared and an equal area of the static wall beside it."""
    appeared_pixels = check_with(view(at=0.0))(view(WITH_BOX, at=0.3))
    mask = torch.zeros(120, 160, dtype=torch.bool)
    mask[40:80, 60:140] = True
    packed = pack_masks(mask, appeared_pixels.stride)
    (fractions,) = appeared_pixels.fractions([packed], [CONFIG.min_points], [False])
    assert fractions[0] == 0.5 and fractions[1].isnan()
    assert appeared_pixels.fractions([packed], [201], [False])[0, 0].isnan()


# ---------------------------------------------------------------- state


def test_state_dict_continues_with_identical_results() -> None:
    original, continued = check_with(view(at=0.0), view(WITH_BOX, at=0.6)), check_with(view(WITH_BOX, at=0.1))
    continued.load_state_dict(original.state_dict())
    for stamp in (0.9, 1.2, 1.5):
        current = original.make_view(stamp, view(WITH_BOX).depth, turned(stamp))
        other = continued.make_view(stamp, view(WITH_BOX).depth, turned(stamp))
        assert current.misalignment == other.misalignment
        torch.testing.assert_close(
            original(current).was_free, continued(other).was_free, rtol=0, atol=0, equal_nan=True
        )
        original.add_view(current, current.T_dw)
        continued.add_view(other, other.T_dw)
    assert not original(view(WITH_BOX, at=1.8)).was_free.isnan().all()
