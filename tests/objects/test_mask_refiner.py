"""Outlines: the rim of a mask, and the surface on which it goes on without an edge."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import StaticMaskConfig, TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.free_space_check import DepthView, NewlyOccupied
from v3d_torch.objects.mask_refiner import MaskRefiner
from v3d_torch.objects.track import Detection3D, Track

CAMERA = PinholeCamera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
WALL, BODY = 4.0, 2.0
STEP = 4
ROWS, COLUMNS = slice(40, 200), slice(120, 180)
"""Where the body is; the network finds what is above row `CUT`."""
CUT = 140
SPACING = 0.02


def depth_of(*surfaces: tuple[slice, slice, float]) -> Tensor:
    """Depth of upright boards before the wall, (1, H, W)."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    for rows, columns, z in ((ROWS, COLUMNS, BODY), *surfaces):
        depth[0, rows, columns] = z
    return depth


def outline(depth: Tensor, came: Tensor | None = None, *, missed: bool = False, **mask: float) -> Tensor:
    """Outline of the body, of which the mask has the upper part."""
    found = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    found[ROWS.start : CUT, COLUMNS] = True
    cloud = (CAMERA.rays * depth[0][..., None])[found & (depth[0] > 0)][::5]
    track = Track(1, found, found & (depth[0] > 0), found.flatten().float(), 0.0, TrackerConfig(), missed=missed)
    track.add_detection(Detection3D(0.0, cloud.mean(dim=0).to(torch.float64), cloud))
    if came is None:
        came = torch.full((1, CAMERA.height // STEP, CAMERA.width // STEP), torch.nan, dtype=torch.float64)
    view = DepthView(0.0, depth, torch.eye(4, dtype=torch.float64))
    return MaskRefiner([track], view, NewlyOccupied(came, STEP), StaticMaskConfig(**mask), CAMERA, SPACING)(track)


def reached(shape: Tensor) -> int:
    """Rows below the cut that are the body's, in the middle of it."""
    return int(shape[CUT : ROWS.stop, 150].sum())


def test_a_body_that_the_mask_cuts_off_is_followed_as_far_as_it_may_be() -> None:
    spacing = SPACING * CAMERA.fx / BODY
    for reach in (16, 32, 48):
        assert abs(reached(outline(depth_of(), reach=reach)) - reach - spacing) <= 2 * STEP
    assert reached(outline(depth_of(), reach=0, margin=8)) <= 8


def test_nothing_of_the_wall_behind_goes_along() -> None:
    body = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    body[ROWS, COLUMNS] = True
    assert not (outline(depth_of(), reach=200) & ~body).any()
    assert (outline(depth_of(), reach=200) & body).sum() == body.sum()


def test_an_edge_of_the_depth_ends_it() -> None:
    """A thing 12 cm before the body, within its tolerance: another surface all the same; to the cell."""
    thing = (slice(160, 200), COLUMNS, BODY - 0.12)
    assert reached(outline(depth_of(thing), reach=100, tolerance=0.2)) <= 160 - CUT + STEP
    assert reached(outline(depth_of(thing), reach=100, tolerance=0.2, edge=0.1)) == ROWS.stop - CUT


def test_what_is_much_larger_than_the_object_does_not_go_along() -> None:
    """The body leans against a wall that stands as near as itself."""
    wall = (slice(148, 240), slice(0, 320), BODY)
    assert reached(outline(depth_of(wall), reach=200, margin=0)) <= STEP
    assert reached(outline(depth_of(wall), reach=200, margin=0, least_part=0.1)) == ROWS.stop - CUT


def test_what_was_there_before_does_not_go_along() -> None:
    came = torch.full((2, CAMERA.height // STEP, CAMERA.width // STEP), torch.nan, dtype=torch.float64)
    came[0, 160 // STEP :] = 0.0
    assert abs(reached(outline(depth_of(), came, reach=100)) - (160 - CUT)) <= STEP
    came[1, 160 // STEP :] = 1.0  # over the other baseline it came: no word that it is still
    assert reached(outline(depth_of(), came, reach=100)) == ROWS.stop - CUT


def test_depth_that_is_missing_is_no_surface() -> None:
    hole = (slice(160, 164), COLUMNS, 0.0)
    assert reached(outline(depth_of(hole), reach=100, margin=0)) <= 160 - CUT


def test_a_missed_object_goes_on_too() -> None:
    assert reached(outline(depth_of(), reach=100, missed=True)) == ROWS.stop - CUT
    assert reached(outline(depth_of(), reach=0, missed=True)) <= STEP
