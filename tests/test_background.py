"""The background's word: which share of an object's places is looked through, and what cannot be told."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import BackgroundConfig
from v3d_torch.lie import invert, se3_exp
from v3d_torch.objects.background import DepthView, moved_share, vacated_share

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
CONFIG = BackgroundConfig()
WALL, OBJECT = 4.0, 2.0
HERE = torch.eye(4, dtype=torch.float64)


def surface(columns: tuple[int, int], rows: tuple[int, int] = (40, 80), z: float = OBJECT) -> Tensor:
    """Points of a board parallel to the image, one per pixel, (P, 3): columns and rows end before the second number."""
    return z * CAMERA.rays[rows[0] : rows[1], columns[0] : columns[1]].reshape(-1, 3)


def view(*boards: tuple[tuple[int, int], float], wall: float = WALL, T_wc: Tensor = HERE) -> DepthView:
    """Boards, each (columns, depth), before a wall; the later ones are painted over the earlier."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), wall)
    for (left, right), z in boards:
        depth[0, 40:80, left:right] = z
    return DepthView(depth, invert(T_wc))


def share(cloud: Tensor, seen: DepthView, **config: float) -> float:
    return vacated_share(cloud, seen, CAMERA, BackgroundConfig(**config))


def test_all_are_still_there() -> None:
    assert share(surface((60, 80)), view(((60, 80), OBJECT))) == 0.0


def test_all_have_gone() -> None:
    assert share(surface((60, 80)), view()) == 1.0


@pytest.mark.parametrize("step", [1, 5, 10, 20])
def test_share_is_what_a_step_aside_uncovers(step: int) -> None:
    assert share(surface((60, 80)), view(((60 + step, 80 + step), OBJECT))) == pytest.approx(step / 20)


def test_hidden_points_have_no_say() -> None:
    """A quarter has gone, half is behind something near: a half of what is in sight has gone."""
    seen = view(((65, 80), OBJECT), ((70, 80), 1.0))
    assert share(surface((60, 80)), seen) == pytest.approx(0.5)


def test_an_occluder_that_hides_all_leaves_nothing_to_tell() -> None:
    assert math.isnan(share(surface((60, 80)), view(((50, 90), 1.0))))


def test_points_beside_the_image_have_no_say() -> None:
    """The camera has moved right by 60 pixels: the left half of the board is out of its sight, a quarter is gone."""
    T_wc = HERE.clone()
    T_wc[0, 3] = 60 * OBJECT / CAMERA.fx
    seen = view(((0, 5), OBJECT), T_wc=T_wc)
    assert share(surface((50, 70)), seen) == pytest.approx(0.5)


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
    assert share(surface((60, 80)), seen) == pytest.approx(0.5)


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


def test_moved_share_is_the_greater_of_leaving_and_coming() -> None:
    """The object comes out from behind a screen: of where it was nothing is in sight, of where it came to all was."""
    then, now = surface((60, 80)), surface((100, 120))
    hidden_then = view(((50, 90), 1.0))
    visible_now = view(((50, 90), 1.0), ((100, 120), OBJECT))
    assert math.isnan(vacated_share(then, visible_now, CAMERA, CONFIG))
    assert moved_share((then, hidden_then), (now, visible_now), CAMERA, CONFIG) == 1.0
    # The same the other way round in time: it goes behind the screen.
    assert moved_share((now, visible_now), (then, hidden_then), CAMERA, CONFIG) == 1.0


def test_what_grows_has_moved_by_the_share_that_is_new() -> None:
    small = surface((60, 80)), view(((60, 80), OBJECT))
    large = surface((60, 100)), view(((60, 100), OBJECT))
    assert vacated_share(small[0], large[1], CAMERA, CONFIG) == 0.0
    assert moved_share(small, large, CAMERA, CONFIG) == pytest.approx(0.5)
    assert moved_share(large, small, CAMERA, CONFIG) == pytest.approx(0.5)


def test_nobody_can_tell() -> None:
    covered = view(((0, 160), 1.0))
    cloud = surface((60, 80))
    assert math.isnan(moved_share((cloud, covered), (cloud, covered), CAMERA, CONFIG))


def test_an_object_cut_by_the_image_border_has_not_moved() -> None:
    """The camera passes a still board, of which ever less is seen: its centroid jumps, its places do not."""
    width = 30 * OBJECT / CAMERA.fx
    T_wc = HERE.clone()
    T_wc[0, 3] = -width / 2  # to the left: the board at the right border slides out
    then = surface((130, 160)), view(((130, 160), OBJECT))
    now_camera = surface((145, 160))
    now = (now_camera.double() + T_wc[:3, 3]).float(), view(((145, 160), OBJECT), T_wc=T_wc)
    assert float((now[0].mean(dim=0) - then[0].mean(dim=0)).norm()) > 0.1
    assert moved_share(then, now, CAMERA, CONFIG) == 0.0


def test_a_still_object_that_something_passes_has_not_moved() -> None:
    whole = surface((60, 80)), view(((60, 80), OBJECT))
    covered = surface((72, 80)), view(((60, 80), OBJECT), ((55, 72), 1.2))
    assert moved_share(whole, covered, CAMERA, CONFIG) == 0.0
    assert moved_share(covered, whole, CAMERA, CONFIG) == 0.0


def test_a_step_towards_the_camera_uncovers_nothing_yet_fills_empty_places() -> None:
    then = surface((60, 80)), view(((60, 80), OBJECT))
    nearer = OBJECT - 0.3
    now = surface((60, 80), z=nearer), view(((60, 80), nearer))
    assert math.isnan(vacated_share(then[0], now[1], CAMERA, CONFIG))
    assert moved_share(then, now, CAMERA, CONFIG) == 1.0
    assert moved_share(now, then, CAMERA, CONFIG) == 1.0


@settings(max_examples=50, deadline=None)
@given(
    st.tuples(*[st.floats(-2.0, 2.0)] * 3, *[st.floats(-1.5, 1.5)] * 3),
    st.integers(0, 20),
)
def test_share_does_not_depend_on_the_choice_of_the_world(xi: tuple[float, ...], step: int) -> None:
    """Depth is chosen so that rounding of float32 points decides no pixel and no tolerance."""
    T_new_old = se3_exp(torch.tensor(xi, dtype=torch.float64))
    cloud = surface((60, 80)).double()
    moved = cloud @ T_new_old[:3, :3].T + T_new_old[:3, 3]
    seen = view(((60 + step, 80 + step), OBJECT), T_wc=T_new_old)
    assert share(moved.float(), seen) == pytest.approx(step / 20)


def test_points_are_looked_for_where_a_bent_ray_meets_the_image() -> None:
    """Every pixel of TUM's fr1 lens is a point; each is found at its own pixel again, and at no other."""
    camera = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    points = OBJECT * camera.rays[::7, ::7].reshape(-1, 3)
    depth = torch.full((1, 480, 640), WALL)
    depth[0, ::7, ::7] = OBJECT
    assert vacated_share(points, DepthView(depth, HERE), camera, CONFIG) < 0.001


def test_a_view_of_another_pose_sees_the_same_slanted_floor() -> None:
    """A floor seen from two poses: no plane parallel to an image, no pixel on the same place, and nothing has moved."""
    tilted = se3_exp(torch.tensor([0.0, 0.0, 0.0, -0.5, 0.0, 0.0], dtype=torch.float64))
    turned = se3_exp(torch.tensor([0.3, -0.1, 0.2, -0.45, 0.15, 0.1], dtype=torch.float64))
    clouds, views = [], []
    for T_wc in (tilted, turned):
        direction = CAMERA.rays.double() @ T_wc[:3, :3].T
        z = (1.2 - T_wc[1, 3]) / direction[..., 1]  # the floor is 1.2 m below the origin
        depth = torch.where((z > 0) & (z < 5.0), z, 0.0)
        views.append(DepthView(depth[None].float(), invert(T_wc)))
        clouds.append((direction * depth[..., None] + T_wc[:3, 3])[depth > 0].float())
    assert float(((clouds[0][:, 1] - 1.2).abs()).max()) < 1e-5
    assert moved_share((clouds[0], views[0]), (clouds[1], views[1]), CAMERA, CONFIG) < 0.01
