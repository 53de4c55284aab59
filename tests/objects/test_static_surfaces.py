"""Static surfaces of earlier views: a wall that a person hides for some seconds."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.static_surfaces import StaticSurfaces

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
HERE = torch.eye(4, dtype=torch.float64)
WALL, PERSON = 3.0, 2.0
BODY = slice(20, 100), slice(60, 100)
"""Pixels of the person."""
STEP = 2
EVERYWHERE = torch.ones(CAMERA.height // STEP, CAMERA.width // STEP, dtype=torch.bool)


def view(stamp: float, *, person: float = 0.0, T_cw: Tensor = HERE) -> DepthView:
    """Return a view of the wall, with the person at a depth unless it is 0."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    if person:
        depth[0][BODY] = person
    return DepthView(stamp, depth, T_cw)


def without_person() -> Tensor:
    """Return the pixels beside the person."""
    static = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
    static[BODY] = False
    return static


def surfaces_with(*views: tuple[DepthView, Tensor], config: FreeSpaceConfig | None = None) -> StaticSurfaces:
    """Return surfaces with views and their static pixels."""
    surfaces = StaticSurfaces(config or FreeSpaceConfig(), CAMERA)
    for each, static in views:
        surfaces.add_view(each, each.T_dw, static)
    return surfaces


ALL_STATIC = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)


def body_of(found: Tensor) -> Tensor:
    """Return the pixels of the person in a coarse image, without those at the border."""
    return found[13:47, 33:47]


def test_wall_that_was_visible_before_the_person_came_is_static() -> None:
    surfaces = surfaces_with((view(0.0), ALL_STATIC), (view(1.0, person=PERSON), without_person()))
    found = surfaces.find(view(2.0), EVERYWHERE, STEP)
    assert body_of(found).all()


def test_wall_that_was_never_visible_and_the_person_are_not_static() -> None:
    surfaces = surfaces_with((view(1.0, person=PERSON), without_person()))
    assert not body_of(surfaces.find(view(2.0), EVERYWHERE, STEP)).any()
    surfaces = surfaces_with((view(0.0), ALL_STATIC), (view(1.0, person=PERSON), without_person()))
    assert not body_of(surfaces.find(view(2.0, person=PERSON), EVERYWHERE, STEP)).any()


def test_person_who_moved_by_some_pixels_is_not_static() -> None:
    """The minimum depth around a pixel beside the person is that of the person."""
    surfaces = surfaces_with((view(1.0, person=PERSON), without_person()))
    moved = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    moved[0][:, 68:108][BODY[0]] = PERSON
    found = surfaces.find(DepthView(2.0, moved, HERE), EVERYWHERE, STEP)
    assert not found[BODY[0].start // STEP : BODY[0].stop // STEP, 34:54].any()


@pytest.mark.parametrize(("newest", "expected"), [(PERSON, True), (WALL, False)])
def test_newest_view_that_observes_the_place_decides(newest: float, expected: bool) -> None:
    """A thing at the place of the person was there, and has gone or not; or it has come since."""
    first = view(0.0, person=WALL if expected else PERSON)
    surfaces = surfaces_with((first, ALL_STATIC), (view(1.0, person=newest), ALL_STATIC))
    assert bool(body_of(surfaces.find(view(2.0, person=PERSON), EVERYWHERE, STEP)).all()) is expected
    assert bool(body_of(surfaces.find(view(2.0, person=PERSON), EVERYWHERE, STEP)).any()) is expected


def test_only_the_given_pixels_within_the_range_of_depths_are_found() -> None:
    surfaces = surfaces_with((view(0.0), ALL_STATIC))
    assert surfaces.find(view(1.0), EVERYWHERE, STEP).all()
    left = EVERYWHERE.clone()
    left[:, 40:] = False
    assert torch.equal(surfaces.find(view(1.0), left, STEP), left)
    near = surfaces_with((view(0.0), ALL_STATIC), config=FreeSpaceConfig(max_depth=WALL - 0.1))
    assert not near.find(view(1.0), EVERYWHERE, STEP).any()
    missing = DepthView(1.0, torch.zeros(1, CAMERA.height, CAMERA.width), HERE)
    assert not surfaces.find(missing, EVERYWHERE, STEP).any()


def test_convention_poses_map_from_the_world_to_the_camera() -> None:
    """The camera has moved by 0.5 m to the wall."""
    T_cw = se3_exp(torch.tensor([0.0, 0.0, -0.5, 0.0, 0.0, 0.0], dtype=torch.float64))
    surfaces = surfaces_with((view(0.0), ALL_STATIC))
    closer = DepthView(1.0, torch.full((1, CAMERA.height, CAMERA.width), WALL - 0.5), T_cw)
    assert surfaces.find(closer, EVERYWHERE, STEP).all()
    assert not surfaces.find(DepthView(1.0, closer.depth, HERE), EVERYWHERE, STEP).any()


def test_views_are_half_a_second_apart_and_at_most_three_seconds_old() -> None:
    surfaces = surfaces_with(*((view(index / 30), ALL_STATIC) for index in range(181)))
    stamps = [each.stamp for each in surfaces.state_dict()["views"]]
    assert stamps == pytest.approx([3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0])


def test_corrected_world_has_the_same_surfaces() -> None:
    T_new_old = se3_exp(torch.tensor([0.7, -0.2, 1.5, 0.2, -0.8, 0.4], dtype=torch.float64))
    surfaces = surfaces_with((view(0.0), ALL_STATIC))
    surfaces.apply_world_correction(T_new_old)
    assert surfaces.find(view(1.0, T_cw=invert(T_new_old)), EVERYWHERE, STEP).all()
    assert not surfaces.find(view(1.0), EVERYWHERE, STEP).all()


def test_no_surface_is_static_without_views_or_without_the_free_space_check() -> None:
    surfaces = surfaces_with((view(0.0), ALL_STATIC))
    surfaces.drop_views()
    assert not surfaces.find(view(1.0), EVERYWHERE, STEP).any()
    disabled = surfaces_with((view(0.0), ALL_STATIC), config=FreeSpaceConfig(enabled=False))
    assert not disabled.find(view(1.0), EVERYWHERE, STEP).any()


def test_state_dict_continues_with_identical_results() -> None:
    original = surfaces_with((view(0.0), ALL_STATIC), (view(1.0, person=PERSON), without_person()))
    continued = surfaces_with((view(0.2, person=PERSON), without_person()))
    continued.load_state_dict(original.state_dict())
    for each in (original, continued):
        each.add_view(view(1.6, person=PERSON), HERE, without_person())
    found = original.find(view(2.0), EVERYWHERE, STEP)
    assert found.any() and torch.equal(found, continued.find(view(2.0), EVERYWHERE, STEP))
