"""Mask refinement: the rim of a mask, and the surface that continues without an edge."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from v3d_torch.config import CloudConfig, FreeSpaceConfig, ObjectsConfig, StaticMaskConfig, TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.packed_masks import pack_masks
from v3d_torch.objects import mask_refiner
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.mask_refiner import MaskRefiner
from v3d_torch.objects.static_surfaces import StaticSurfaces
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.segmentation.coco import PERSON

CAMERA = PinholeCamera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
WALL, BODY = 4.0, 2.0
STEP = 4
ROWS, COLUMNS = slice(40, 200), slice(120, 180)
"""Pixels of the body; the network segments the part above row `CUT`."""
CUT = 140
SPACING = 0.02


def depth_of(*surfaces: tuple[slice, slice, float]) -> Tensor:
    """Return the depth of upright boards in front of the wall, (1, H, W)."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    for rows, columns, z in ((ROWS, COLUMNS, BODY), *surfaces):
        depth[0, rows, columns] = z
    return depth


def refine(
    depth: Tensor,
    appeared: Tensor | None = None,
    *,
    missed: bool = False,
    cloud_end: int = CUT,
    beside: int = 0,
    static: Tensor | None = None,
    label: int = PERSON,
    surface_only: bool = False,
    before: Tensor | None = None,
    **mask: float,
) -> Tensor:
    """Return the refined mask of the body.

    The mask of the network has the upper part only, and some columns ``beside`` it, whose depth is not in the cloud;
    the cloud can have more rows. The pixels ``static`` were a part of the static scene in an earlier view.
    With ``surface_only``, the other parts of the mask are left out. The pixels ``before`` were in the cloud of the
    detection before.
    """
    segmented = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    segmented[ROWS.start : CUT, COLUMNS] = True
    seen = torch.zeros_like(segmented)
    seen[ROWS.start : cloud_end, COLUMNS] = True
    cloud = (CAMERA.rays * depth[0][..., None])[seen & (depth[0] > 0)][::5]
    pixels = segmented & (depth[0] > 0)
    segmented[ROWS.start : CUT, COLUMNS.stop : COLUMNS.stop + beside] = True
    packed = pack_masks(segmented, STEP), pack_masks(pixels, STEP)
    track = Track(1, 0.0, TrackerConfig(), segmented, pixels, *packed, missed=missed)
    track.update_label(label, 0.9)
    if before is not None:
        earlier = (CAMERA.rays * depth[0][..., None])[before][::5]
        track.add_detection(Detection3D(-1 / 30, torch.full((3,), torch.nan, dtype=torch.float64), earlier))
    track.add_detection(Detection3D(0.0, cloud.mean(dim=0).to(torch.float64), cloud))
    if appeared is None:
        appeared = torch.full((1, CAMERA.height // STEP, CAMERA.width // STEP), torch.nan, dtype=torch.float64)
    view = DepthView(0.0, depth, torch.eye(4, dtype=torch.float64))
    surfaces = StaticSurfaces(FreeSpaceConfig(), CAMERA)
    if static is not None:
        surfaces.add_view(view, view.T_dw, static)
    config = ObjectsConfig(clouds=CloudConfig(voxel_size=SPACING), static_mask=StaticMaskConfig(**mask))
    refiner = MaskRefiner([track], view, AppearedPixels(appeared, STEP), surfaces, config, CAMERA)
    refined = refiner.refine(track)
    image = torch.zeros_like(segmented)
    image[refined.crop] = torch.from_numpy(refined.surface if surface_only else refined.mask)
    return image


def rows_below_cut(shape: Tensor) -> int:
    """Return the number of rows below the cut that the mask contains, in the middle of the body."""
    return int(shape[CUT : ROWS.stop, 150].sum())


def test_surface_margin_limits_the_growth() -> None:
    spacing = SPACING * CAMERA.fx / BODY
    for margin in (16, 32, 48):
        assert abs(rows_below_cut(refine(depth_of(), surface_margin=margin)) - margin - spacing) <= 2 * STEP
    assert rows_below_cut(refine(depth_of(), surface_margin=0, depth_margin=8)) <= 8


def test_surface_margin_counts_from_the_mask_also_if_the_cloud_is_larger() -> None:
    for margin in (16, 32):
        assert abs(rows_below_cut(refine(depth_of(), surface_margin=margin, cloud_end=ROWS.stop)) - margin) <= 2 * STEP


def test_depth_tolerance_grows_with_the_square_of_depth() -> None:
    """At 2 m, the tolerance of 5 cm grows by 4 cm."""
    for distance, rows in ((-0.1, 0), (-0.08, 8), (0.08, 8), (0.1, 0)):
        board = (slice(CUT, ROWS.stop), COLUMNS, BODY + distance)
        assert rows_below_cut(refine(depth_of(board), surface_margin=0, depth_margin=8, depth_tolerance=0.05)) == rows


def test_missing_depth_around_the_mask_is_included() -> None:
    hole = (slice(CUT, ROWS.stop), COLUMNS, 0.0)
    assert rows_below_cut(refine(depth_of(hole), surface_margin=0, depth_margin=8)) == 8


def test_wall_behind_the_body_is_excluded() -> None:
    body = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    body[ROWS, COLUMNS] = True
    assert not (refine(depth_of(), surface_margin=200) & ~body).any()
    assert (refine(depth_of(), surface_margin=200) & body).sum() == body.sum()


def test_depth_edge_ends_the_growth() -> None:
    """A thing in front of the body, within its depth tolerance, is another surface; a fold of its clothes is not."""
    for distance, end in ((0.12, 160 + STEP), (0.04, ROWS.stop)):
        thing = (slice(160, 200), COLUMNS, BODY - distance)
        assert 0 <= end - CUT - rows_below_cut(refine(depth_of(thing), surface_margin=100, depth_tolerance=0.2)) <= 12


def test_surface_much_larger_than_the_object_is_excluded() -> None:
    """The body leans against a wall at the same depth."""
    wall = (slice(148, 240), slice(0, 320), BODY)
    assert rows_below_cut(refine(depth_of(wall), surface_margin=200, depth_margin=0)) <= STEP
    assert (
        rows_below_cut(refine(depth_of(wall), surface_margin=200, depth_margin=0, min_surface_fraction=0.1))
        == ROWS.stop - CUT
    )


def test_surface_that_was_there_before_is_excluded() -> None:
    appeared = torch.full((2, CAMERA.height // STEP, CAMERA.width // STEP), torch.nan, dtype=torch.float64)
    appeared[0, 160 // STEP :] = 0.0
    assert abs(rows_below_cut(refine(depth_of(), appeared, surface_margin=100)) - (160 - CUT)) <= STEP
    appeared[1, 160 // STEP :] = 1.0  # free over the other time span: not static
    assert rows_below_cut(refine(depth_of(), appeared, surface_margin=100)) == ROWS.stop - CUT


def test_static_surface_of_an_earlier_view_is_excluded_from_a_person_but_not_from_a_thing() -> None:
    """A thing that moves now can have been a static surface before."""
    static = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    static[160:] = True
    for label, expected in ((PERSON, 160), (56, ROWS.stop)):
        grown = refine(depth_of(), static=static, label=label, surface_margin=100)
        assert abs(rows_below_cut(grown) - (expected - CUT)) <= STEP


def test_static_surface_is_excluded_within_the_depth_margin_but_not_from_the_mask() -> None:
    static = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
    refined = refine(depth_of(), static=static, surface_margin=0, depth_margin=8)
    assert rows_below_cut(refined) == 0
    assert refined[ROWS.start : CUT, COLUMNS].all()


def test_static_surface_is_excluded_only_if_the_pose_is_known() -> None:
    static = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
    not_compared = torch.zeros(0, CAMERA.height // STEP, CAMERA.width // STEP, dtype=torch.float64)
    grown = refine(depth_of(), not_compared, static=static, surface_margin=100)
    assert rows_below_cut(grown) == ROWS.stop - CUT


def test_missing_depth_ends_the_growth() -> None:
    hole = (slice(160, 164), COLUMNS, 0.0)
    assert rows_below_cut(refine(depth_of(hole), surface_margin=100, depth_margin=0)) <= 160 - CUT


def test_mask_of_a_missed_object_grows() -> None:
    assert rows_below_cut(refine(depth_of(), surface_margin=100, missed=True)) == ROWS.stop - CUT
    assert rows_below_cut(refine(depth_of(), surface_margin=0, missed=True)) <= STEP


def test_concave_edge_ends_the_growth() -> None:
    """The body stands behind the edge of a table, whose near side lies within the depth tolerance: no depth edge.

    The edge is below the mask, or within it.
    """
    lenient = {"surface_margin": 100.0, "depth_margin": 0.0, "depth_tolerance": 1.0, "edge_ratio": 0.1}
    for edge in (160, 128):
        depth = depth_of()
        slope = torch.arange(ROWS.stop - edge) * 0.004  # of the inverse depth of a plane, 1/m per pixel
        depth[0, edge : ROWS.stop, COLUMNS] = (1 / (1 / BODY + slope))[:, None]
        assert rows_below_cut(refine(depth, **lenient)) <= max(edge - CUT, 0) + STEP
    assert rows_below_cut(refine(depth_of(), **lenient)) == ROWS.stop - CUT


def test_second_body_in_the_mask_is_kept_unless_its_surface_was_there_before() -> None:
    """The network draws one mask over the body and another one behind it, which is not in the cloud."""
    width = 40
    behind = (ROWS, slice(COLUMNS.stop, COLUMNS.stop + width), 3.0)
    refined = refine(depth_of(behind), beside=width, surface_margin=0)
    second = slice(ROWS.start, CUT), slice(COLUMNS.stop, COLUMNS.stop + width)
    assert refined[second].double().mean() > 0.9
    assert not refine(depth_of(behind), beside=width, surface_margin=0, surface_only=True)[second].any()
    appeared = torch.zeros(1, CAMERA.height // STEP, CAMERA.width // STEP, dtype=torch.float64)
    assert refine(depth_of(behind), appeared, beside=width, surface_margin=0)[second].double().mean() < 0.1
    appeared[:] = 1.0
    assert refine(depth_of(behind), appeared, beside=width, surface_margin=0)[second].double().mean() > 0.9


def test_part_of_the_mask_that_belonged_to_the_object_at_its_last_detection_is_kept() -> None:
    """An arm is the largest cluster now; the body behind it was there before, as the wall was."""
    width = 40
    body = ROWS, slice(COLUMNS.stop, COLUMNS.stop + width)
    appeared = torch.zeros(1, CAMERA.height // STEP, CAMERA.width // STEP, dtype=torch.float64)
    before = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    before[body] = True
    part = slice(ROWS.start, CUT), body[1]
    for z, expected in ((2.4, True), (WALL, False)):
        depth = depth_of((*body, z))
        refined = refine(depth, appeared, beside=width, surface_margin=0, before=before if expected else None)
        assert bool(refined[part].double().mean() > 0.9) is expected
        assert not refined[CUT + STEP :, COLUMNS.stop + STEP :].any(), "only the network's mask can be kept"


def test_narrow_background_along_the_contour_of_a_mask_is_not_kept() -> None:
    refined = refine(depth_of(), beside=10, surface_margin=0, depth_margin=0)
    assert not refined[ROWS.start : CUT, COLUMNS.stop + STEP :].any()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("surface", "margin"), [(32, 8), (0, 20), (48, 0), (0, 0), (200, 100)])
def test_refined_mask_does_not_depend_on_the_part_of_the_image_that_is_examined(
    seed: int, surface: int, margin: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.integers(0, (CAMERA.height - 60, CAMERA.width - 60), (12, 2)).tolist()
    boards = [
        (slice(v, v + 60), slice(u, u + 60), float(z))
        for (v, u), z in zip(corners, rng.choice([0.0, BODY, BODY + 0.05, 3.0], 12), strict=True)
    ]
    appeared = torch.from_numpy(rng.choice([0.0, 1.0, np.nan], (1, CAMERA.height // STEP, CAMERA.width // STEP)))
    options = {"beside": 30, "surface_margin": surface, "depth_margin": margin}
    found = refine(depth_of(*boards), appeared, **options)
    everywhere = slice(0, CAMERA.height), slice(0, CAMERA.width)
    monkeypatch.setattr(mask_refiner, "crop_around", lambda *_: everywhere)
    assert found.any() and torch.equal(found, refine(depth_of(*boards), appeared, **options))
