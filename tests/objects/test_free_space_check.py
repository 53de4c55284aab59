"""The background's word: what of an object is looked through, what came where nothing was, what cannot be told."""

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
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.free_space_check import (
    DepthView,
    FreeSpaceCheck,
    NewlyOccupied,
    is_free_space,
    vacated_fractions,
)

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
CONFIG = FreeSpaceConfig()
WALL, OBJECT = 4.0, 2.0
RIM = 2  # 1 % of 160 pixels: so near to something seen at its depth or before it, a place is not looked through
HERE = torch.eye(4, dtype=torch.float64)
TWISTS = st.tuples(*[st.floats(-2.0, 2.0)] * 3, *[st.floats(-1.5, 1.5)] * 3)


@pytest.fixture(autouse=True)
def every_fourth_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with a camera of the usual size."""
    monkeypatch.setattr(FreeSpaceCheck, "_ROW", CAMERA.width // 4)


def surface(columns: tuple[int, int], rows: tuple[int, int] = (40, 80), z: float = OBJECT) -> Tensor:
    """Points of a board parallel to the image, one per pixel, (P, 3): columns and rows end before the second number."""
    return z * CAMERA.rays[rows[0] : rows[1], columns[0] : columns[1]].reshape(-1, 3)


def view(*boards: tuple[tuple[int, int], float], wall: float = WALL, T_wc: Tensor = HERE, at: float = 0.0) -> DepthView:
    """Boards, each (columns, depth), before a wall; the later ones are painted over the earlier."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), wall)
    for (left, right), z in boards:
        depth[0, 40:80, left:right] = z
    return DepthView(at, depth, invert(T_wc))


def share(cloud: Tensor, seen: DepthView, **config: float) -> float:
    return float(vacated_fractions([cloud], seen, CAMERA, FreeSpaceConfig(**config))[0])


# ---------------------------------------------------------------- what is looked through


@pytest.mark.parametrize(("height", "width", "side"), [(120, 160, 5), (48, 64, 3), (20, 30, 1), (480, 640, 13)])
def test_nearest_is_the_least_measured_depth_around(height: int, width: int, side: int) -> None:
    depth = torch.rand(1, height, width, generator=torch.Generator().manual_seed(0)) + 0.5
    depth[depth < 0.7] = 0.0
    measured = np.where(depth[0] > 0, depth[0], np.inf)
    expected = np.where(depth[0] > 0, minimum_filter(measured, side, mode="constant", cval=np.inf), 0.0)
    assert torch.equal(DepthView(0.0, depth, HERE).nearest, torch.from_numpy(expected.astype(np.float32)))


def turned(degrees: float) -> Tensor:
    """World to a camera that is turned to the right."""
    return se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, -math.radians(degrees), 0.0], dtype=torch.float64))


def test_the_faster_the_camera_turns_the_farther_a_place_may_be_off() -> None:
    """3 degrees in 0.1 s: in the 0.02 s between colour and depth 0.6 degrees, times the focal length in pixels."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    watching = FreeSpaceCheck(FreeSpaceConfig(depth_sync_error=0.02), CAMERA)
    assert watching.make_view(0.0, depth, HERE).shift == 0  # nothing to measure a turn by
    watching.remember(view())
    assert watching.make_view(0.1, depth, HERE).shift == 0
    assert watching.make_view(0.1, depth, turned(3.0)).shift == round(math.radians(0.6) * CAMERA.fx)
    assert watching.make_view(0.1, depth, turned(60.0)).shift == round(math.radians(12.0) * CAMERA.fx)
    assert FreeSpaceCheck(FreeSpaceConfig(depth_sync_error=0.0), CAMERA).make_view(0.1, depth, turned(60.0)).shift == 0
    moved = torch.eye(4, dtype=torch.float64)
    moved[0, 3] = 0.5
    assert watching.make_view(0.1, depth, moved).shift == 0


@pytest.mark.parametrize(("shift", "expected"), [(0, 1.0), (6, 0.0)])
def test_a_place_beside_something_is_not_looked_through_by_a_camera_that_turns(shift: int, expected: float) -> None:
    """The box was 5 pixels beside the place, no more than its depth may be off: nothing has left."""
    seen = replace(view(((65, 85), OBJECT)), shift=shift)
    assert share(surface((57, 63)), seen) == expected


def test_all_are_still_there() -> None:
    assert share(surface((60, 80)), view(((60, 80), OBJECT))) == 0.0


def test_all_have_gone() -> None:
    assert share(surface((60, 80)), view()) == 1.0


@pytest.mark.parametrize("step", [0, 1, 2, 3, 5, 10, 20, 22, 30])
def test_share_is_what_a_step_aside_uncovers_but_for_the_rim(step: int) -> None:
    expected = min(max(step - RIM, 0), 20) / 20
    assert share(surface((60, 80)), view(((60 + step, 80 + step), OBJECT))) == pytest.approx(expected)


def test_hidden_points_have_no_say() -> None:
    """Of 20 columns 3 are looked through, 5 are there or beside what is; 12 are behind something near or at its rim."""
    seen = view(((65, 80), OBJECT), ((70, 80), 1.0))
    told = is_free_space(surface((60, 80)).double(), seen, CAMERA, CONFIG).reshape(40, 20)
    expected = torch.tensor([1.0] * 3 + [0.0] * 5 + [torch.nan] * 12, dtype=torch.float64).expand(40, 20)
    torch.testing.assert_close(told, expected, rtol=0, atol=0, equal_nan=True)
    assert share(surface((60, 80)), seen) == pytest.approx(3 / 8)


def test_an_occluder_that_hides_all_leaves_nothing_to_tell() -> None:
    assert math.isnan(share(surface((60, 80)), view(((50, 90), 1.0))))


def test_points_beside_the_image_have_no_say() -> None:
    """The camera has moved right by 60 pixels: the left half of the board is out of its sight, 3 of 10 are gone."""
    T_wc = HERE.clone()
    T_wc[0, 3] = 60 * OBJECT / CAMERA.fx
    seen = view(((0, 5), OBJECT), T_wc=T_wc)
    assert share(surface((50, 70)), seen) == pytest.approx(0.3)


def test_points_up_to_the_border_have_a_say() -> None:
    for columns, rows in (((150, 160), (40, 80)), ((0, 10), (40, 80)), ((60, 80), (110, 120)), ((60, 80), (0, 10))):
        assert share(surface(columns, rows), view()) == 1.0


def test_points_behind_the_camera_have_no_say() -> None:
    T_wc = HERE.clone()
    T_wc[2, 3] = OBJECT + 1.0
    assert math.isnan(share(surface((60, 80)), view(T_wc=T_wc)))


def test_points_nearer_than_the_camera_can_measure_have_no_say() -> None:
    near = surface((60, 80), z=0.29)
    assert math.isnan(share(near, view()))
    assert share(near, view(), min_depth=0.2) == 1.0


def test_pixels_without_depth_have_no_say() -> None:
    seen = view(((60, 80), OBJECT))
    seen.depth[0, 40:80, 60:70] = 0.0
    seen.depth[0, 40:80, 70:75] = WALL
    assert share(surface((60, 80)), seen) == pytest.approx((5 - RIM) / 10)


@pytest.mark.parametrize(("points", "told"), [(29, False), (30, True)])
def test_fewest_points_that_tell(points: int, told: bool) -> None:
    assert math.isnan(share(surface((60, 80))[:points], view())) is not told


def test_no_points_tell_nothing() -> None:
    assert math.isnan(share(torch.zeros(0, 3), view()))


@pytest.mark.parametrize(
    ("z", "behind", "gone"),
    [
        (1.0, 0.039, 0.0),  # within the 4 cm that always count as the same
        (1.0, 0.041, 1.0),
        (3.0, 0.089, 0.0),  # 1 cm times 3 squared
        (3.0, 0.091, 1.0),
    ],
)
def test_tolerance_grows_with_the_square_of_depth_from_a_least_one_on(z: float, behind: float, gone: float) -> None:
    assert share(surface((60, 80), z=z), view(wall=z + behind)) == gone


@pytest.mark.parametrize("z", [1.0, 3.0])
def test_tolerance_towards_the_camera_is_the_same(z: float) -> None:
    """A little nearer than expected is the point itself, seen; much nearer hides it."""
    tolerance = max(0.04, 0.01 * z * z)
    assert share(surface((60, 80), z=z), view(wall=z - 0.9 * tolerance)) == 0.0
    assert math.isnan(share(surface((60, 80), z=z), view(wall=z - 1.1 * tolerance)))


def test_an_object_that_has_come_out_of_hiding_has_vacated_nothing() -> None:
    """Of where it was nothing is in sight, of where it came to all was: the two views tell different things."""
    screen = ((50, 90), 1.0)
    assert math.isnan(share(surface((60, 80)), view(screen, ((100, 120), OBJECT))))
    assert share(surface((100, 120)), view(screen)) == 1.0


def test_an_object_cut_by_the_image_border_has_vacated_nothing() -> None:
    """The camera passes a still board, of which ever less is seen: its centroid jumps, its places do not."""
    T_wc = HERE.clone()
    T_wc[0, 3] = -15 * OBJECT / CAMERA.fx  # to the left: the board at the right border slides out
    assert share(surface((130, 160)), view(((145, 160), OBJECT), T_wc=T_wc)) == 0.0


def test_a_still_object_that_something_passes_has_vacated_nothing() -> None:
    covered = view(((60, 80), OBJECT), ((55, 72), 1.2))
    assert share(surface((60, 80)), covered) == 0.0


@settings(max_examples=50, deadline=None)
@given(TWISTS, st.integers(RIM, 20))
def test_share_does_not_depend_on_the_choice_of_the_world(xi: tuple[float, ...], step: int) -> None:
    """Depth is chosen so that rounding of float32 points decides no pixel and no tolerance."""
    T_new_old = se3_exp(torch.tensor(xi, dtype=torch.float64))
    cloud = surface((60, 80)).double()
    moved = cloud @ T_new_old[:3, :3].T + T_new_old[:3, 3]
    seen = view(((60 + step, 80 + step), OBJECT), T_wc=T_new_old)
    assert share(moved.float(), seen) == pytest.approx((step - RIM) / 20)


@pytest.mark.parametrize("pixel", [(20, 30), (20, 610), (450, 30), (460, 620), (240, 320)])
def test_points_are_looked_for_where_a_bent_ray_meets_the_image(pixel: tuple[int, int]) -> None:
    """The strong lens of TUM's fr1. A wall behind something near with a hole: one pixel alone looks through it."""
    camera = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    v, u = pixel
    depth = torch.full((1, 480, 640), 1.0)
    depth[0, v - 6 : v + 7, u - 6 : u + 7] = WALL
    around = OBJECT * camera.rays[v - 1 : v + 2, u - 1 : u + 2].double().reshape(9, 3)
    told = is_free_space(around, DepthView(0.0, depth, HERE), camera, CONFIG)
    assert told[4] == 1.0 and told.isnan().sum() == 8


@pytest.mark.parametrize("degrees", [30, 35, 45, 58, 60, 62, 75, 89])
def test_a_lens_folds_nothing_from_afar_into_the_image(degrees: float) -> None:
    """Bonn's polynomial lens maps a ray at 60 degrees to a pixel; the image ends at 31."""
    lens = (0.039903, -0.099343, -0.000730, -0.000144, 0.0)
    camera = PinholeCamera(542.822841, 542.576870, 315.593520, 237.756098, distortion=lens)
    aside = math.tan(math.radians(degrees))
    points = OBJECT * torch.tensor([[aside, 0.0, 1.0], [-aside, 0.0, 1.0], [0.0, aside, 1.0]], dtype=torch.float64)
    told = is_free_space(points, DepthView(0.0, torch.full((1, 480, 640), WALL), HERE), camera, CONFIG)
    assert told.isnan().tolist() == [degrees > 30.5, degrees > 30.5, True]


def test_a_view_of_another_pose_sees_the_same_slanted_floor() -> None:
    """A floor seen from two poses: no plane parallel to an image, no pixel on the same place, and nothing has moved."""
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
    assert share(clouds[0], views[1]) < 0.001
    assert share(clouds[1], views[0]) < 0.001


def test_shares_of_several_clouds_are_those_of_each() -> None:
    clouds = [surface((60, 80)), torch.zeros(0, 3), surface((50, 70)), surface((0, 20))]
    seen = view(((65, 85), OBJECT))
    together = vacated_fractions(clouds, seen, CAMERA, CONFIG)
    torch.testing.assert_close(together.tolist(), [share(cloud, seen) for cloud in clouds], equal_nan=True)
    assert vacated_fractions([], seen, CAMERA, CONFIG).shape == (0,)


# ---------------------------------------------------------------- what came

BOX = 10, 20, 15, 25
"""Rows and columns of the box in arrivals, every fourth pixel: rows 40 to 80, columns 60 to 100 of the image."""
WITH_BOX = ((60, 100), OBJECT)


def watch(*views: DepthView, **config: object) -> FreeSpaceCheck:
    """A watch that has seen views."""
    watching = FreeSpaceCheck(FreeSpaceConfig(**config), CAMERA)
    for seen in views:
        watching.remember(seen)
    return watching


def box(came: Tensor) -> Tensor:
    top, bottom, left, right = BOX
    return came[..., top:bottom, left:right]


def around(came: Tensor) -> Tensor:
    """All pixels but the box's and those beside it."""
    top, bottom, left, right = BOX
    outside = torch.ones(came.shape[-2:], dtype=torch.bool)
    outside[top - 1 : bottom + 1, left - 1 : right + 1] = False
    return came[..., outside]


def room(T_wc: Tensor, *, with_box: bool, at: float) -> DepthView:
    """A wall at z = 4 m and a box at 2 m of 0.6 x 0.6 m, by the rays of a camera that may be anywhere."""
    direction = CAMERA.rays.double() @ T_wc[:3, :3].T
    hit = T_wc[:3, 3] + direction * ((OBJECT - T_wc[2, 3]) / direction[..., 2])[..., None]
    on_box = with_box & (hit[..., :2].abs() < 0.3).all(dim=-1)
    depth = (torch.where(on_box, OBJECT, WALL) - T_wc[2, 3]) / direction[..., 2]
    return DepthView(at, depth[None].float(), invert(T_wc))


def test_a_box_that_comes_has_come_and_the_wall_around_it_has_not() -> None:
    came = watch(view(at=0.0))(view(WITH_BOX, at=0.3)).appeared
    assert came.shape == (2, 30, 40) and came.dtype == torch.float64
    assert (box(came[0]) == 1).all()
    assert (around(came[0]) == 0).all()
    assert came[1].isnan().all()  # nothing was seen 0.9 s ago


def test_a_box_that_stood_there_has_not_come() -> None:
    """At its rim it hides the wall: there it cannot be told."""
    came = watch(view(WITH_BOX, at=0.0))(view(WITH_BOX, at=0.9)).appeared
    assert (box(came) == 0).all() and (around(came) == 0).all()
    assert not (came == 1).any()


def test_what_a_box_uncovers_cannot_be_told() -> None:
    """The wall behind was hidden: that the box has left is not for the watch to say."""
    came = watch(view(WITH_BOX, at=0.0))(view(at=0.3)).appeared[0]
    assert box(came).isnan().all()
    assert (around(came) == 0).all()


def test_what_comes_out_from_behind_a_screen_cannot_be_told() -> None:
    came = watch(view(((50, 110), 1.0), at=0.0))(view(WITH_BOX, at=0.3)).appeared[0]
    assert box(came).isnan().all()


def test_what_was_out_of_view_cannot_be_told() -> None:
    turned = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, math.pi / 2, 0.0], dtype=torch.float64))
    assert watch(view(at=0.0, T_wc=turned))(view(WITH_BOX, at=0.3)).appeared.isnan().all()


def test_without_depth_then_nothing_can_be_told() -> None:
    assert watch(view(wall=0.0, at=0.0))(view(WITH_BOX, at=0.3)).appeared.isnan().all()


@pytest.mark.parametrize(("z", "told"), [(0.0, False), (0.29, False), (0.31, True), (2.9, True), (3.1, False)])
def test_only_what_has_a_depth_within_the_range_now_can_have_come(z: float, told: bool) -> None:
    came = watch(view(at=0.0), max_depth=3.0)(view(((60, 100), z), at=0.3)).appeared[0]
    assert (~box(came).isnan()).all() if told else box(came).isnan().all()
    assert around(came).isnan().all()  # the wall is beyond the range


def test_nothing_is_told_where_nothing_is_remembered() -> None:
    assert watch()(view(WITH_BOX)).appeared.isnan().all()


def test_the_view_itself_is_not_what_it_is_compared_with() -> None:
    seen = view(WITH_BOX, at=0.0)
    assert watch(seen)(seen).appeared.isnan().all()


def test_turned_off_there_is_nothing_to_compare_with() -> None:
    arrivals = watch(view(at=0.0), enabled=False)(view(WITH_BOX, at=0.9))
    assert arrivals.appeared.shape == (0, 30, 40)
    assert arrivals.fractions([torch.ones(120, 160, dtype=torch.bool)], 1).shape == (1, 0)


def test_a_pose_that_is_a_guess_tells_nothing() -> None:
    watching, now = watch(view(at=0.0)), view(WITH_BOX, at=0.9)
    assert watching(now, trusted=False).appeared.numel() == 0
    assert watching(now).appeared.shape[0] == 2


@pytest.mark.parametrize("rate", [5, 10, 30])
def test_each_baseline_is_as_long_as_it_says(rate: int) -> None:
    """The box has come at 2 s: over 0.3 s for so long, and over 0.9 s; before it, for ever, it was not there."""
    watching = watch()
    steps = {baseline: -(-round(baseline * 1000) * rate // 1000) for baseline in (0.3, 0.9)}  # whole frames
    for frame in range(4 * rate):
        now = view(*[WITH_BOX] * (frame >= 2 * rate), at=frame / rate)
        came = watching(now).appeared
        for row, baseline in zip(came, (0.3, 0.9), strict=True):
            expected = 2 * rate <= frame < 2 * rate + steps[baseline]
            if frame < steps[baseline]:
                assert row.isnan().all()
            else:
                assert (box(row) == expected).all() and (around(row) == 0).all()
        watching.remember(now)


def test_what_is_older_than_the_longest_baseline_is_forgotten() -> None:
    watching, kept = watch(), []
    for frame in range(100):
        seen = view(at=frame / 10)
        kept.append(weakref.ref(seen))
        watching.remember(seen)
    del seen
    gc.collect()
    assert 10 <= sum(ref() is not None for ref in kept) <= 13


MOVES = [(0.3, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.5, 0.0, 0.0, 0.0), (0.1, -0.1, 0.2, 0.05, -0.1, 0.1)]


@pytest.mark.parametrize("twist", MOVES)
def test_in_a_still_room_nothing_comes_however_the_camera_moves(twist: tuple[float, ...]) -> None:
    T_wc = se3_exp(torch.tensor(twist, dtype=torch.float64))
    for then, now in ((HERE, T_wc), (T_wc, HERE)):
        came = watch(room(then, with_box=True, at=0.0))(room(now, with_box=True, at=0.3)).appeared[0]
        assert not (came == 1).any()
        assert (came == 0).double().mean() > 0.6


@pytest.mark.parametrize("twist", MOVES)
def test_a_box_has_come_however_the_camera_moves(twist: tuple[float, ...]) -> None:
    T_wc = se3_exp(torch.tensor(twist, dtype=torch.float64))
    now = room(T_wc, with_box=True, at=0.3)
    came = watch(room(HERE, with_box=False, at=0.0))(now).appeared[0]
    on_box = now.depth[0, ::4, ::4] < 3.0
    assert on_box.sum() > 80
    assert torch.equal(came == 1, on_box)


@settings(max_examples=20, deadline=None)
@given(TWISTS)
def test_a_world_that_is_moved_takes_its_views_along(twist: tuple[float, ...]) -> None:
    """A closed loop moves the map and the camera in it: what came, and what did not, stays the same."""
    T_new_old = se3_exp(torch.tensor(twist, dtype=torch.float64))
    watching = watch(view(at=0.0), view(WITH_BOX, at=0.6))
    expected = watching(view(WITH_BOX, at=0.9)).appeared
    assert (box(expected[0]) == 0).all() and (box(expected[1]) == 1).all()
    watching.move_world(T_new_old)
    came = watching(view(WITH_BOX, at=0.9, T_wc=T_new_old)).appeared
    torch.testing.assert_close(came, expected, rtol=0, atol=0, equal_nan=True)


# ---------------------------------------------------------------- an object's share of it


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(1, 5), st.integers(1, 40))
def test_share_of_an_object_is_the_mean_of_what_is_told(seed: int, baselines: int, stride: int, least: int) -> None:
    rng = np.random.default_rng(seed)
    came = rng.choice([0.0, 1.0, np.nan], (baselines, 7, 9), p=[0.3, 0.2, 0.5])
    masks = [rng.random((7 * stride, 9 * stride)) < rng.random() for _ in range(3)]
    shares = NewlyOccupied(torch.from_numpy(came), stride).fractions([torch.from_numpy(mask) for mask in masks], least)
    assert shares.dtype == torch.float64 and shares.shape == (3, baselines)
    for row, mask in zip(shares, masks, strict=True):
        within = [
            [came[b, v, u] for v, u in np.ndindex(7, 9) if mask[v * stride, u * stride]] for b in range(baselines)
        ]
        told = [[value for value in values if not math.isnan(value)] for values in within]
        expected = [sum(values) / len(values) if len(values) >= least else math.nan for values in told]
        torch.testing.assert_close(row, torch.tensor(expected).double(), equal_nan=True, rtol=1e-6, atol=0)


def test_share_of_half_a_box_is_a_half() -> None:
    """The mask covers the box that came and as much of the wall beside it, which did not."""
    arrivals = watch(view(at=0.0))(view(WITH_BOX, at=0.3))
    mask = torch.zeros(120, 160, dtype=torch.bool)
    mask[40:80, 60:140] = True
    (shares,) = arrivals.fractions([mask], CONFIG.min_points)
    assert shares[0] == 0.5 and shares[1].isnan()
    assert arrivals.fractions([mask], 201)[0, 0].isnan()
