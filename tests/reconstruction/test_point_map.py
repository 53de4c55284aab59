"""Point map against plain voxel means, its normals, and removal of points in free space."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.box_room import CAMERA, CRATE, EYE, ROOM, distance_to, keyframe, looking_around, render
from scipy.ndimage import binary_erosion, generate_binary_structure
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.geometry.depth_units import STORED_UNIT
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.reconstruction import point_map as point_map_module
from v3d_torch.reconstruction.point_blocks import PointBlocks
from v3d_torch.reconstruction.point_map import PointMap, fuse_points

ALL = torch.ones(240, 320, dtype=torch.bool)
GREY = torch.full((3, 240, 320), 128, dtype=torch.uint8)


def config(**settings: float) -> Config:
    return load_config(overrides=[f"dense_map.{name}={value}" for name, value in settings.items()])


def views_of(*images: tuple[Tensor, Tensor], stride: int = 1) -> StaticViews:
    """Views from pairs of a pose T_cw and a depth image, in which all pixels are static."""
    views = StaticViews(CAMERA, stride)
    for T_cw, depth in images:
        views.add(keyframe(T_cw), GREY, depth, ALL)
    return views


def wall(z: float) -> Tensor:
    return torch.full((1, 240, 320), z)


# --- fusion


def test_points_equal_plain_voxel_means() -> None:
    generator = torch.Generator().manual_seed(3)
    views = StaticViews(CAMERA, 4)
    voxels: dict[tuple[int, ...], list[np.ndarray]] = {}
    for T_wc in looking_around(2) @ se3_exp(torch.tensor([0.0, 0, 0, 0, 0.2, 0], dtype=torch.float64)):
        depth = (render(T_wc) / STORED_UNIT).round() * STORED_UNIT
        depth[0, :20] = 0.0
        image = torch.randint(0, 256, (3, 240, 320), generator=generator, dtype=torch.uint8)
        static = torch.rand(60, 80, generator=generator).repeat_interleave(4, 0).repeat_interleave(4, 1) > 0.1
        views.add(keyframe(invert(T_wc)), image, depth, static)
        v, u = np.mgrid[0:240:4, 0:320:4]
        z = depth[0].numpy()[v, u].astype(np.float64)
        # On a smooth surface a pixel has a normal if its four neighbours are valid.
        valid = static.numpy()[v, u] & (z > 0)
        keep = binary_erosion(valid, generate_binary_structure(2, 1)) & (z <= 1.7)
        u, v, z = u[keep], v[keep], z[keep]
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(z)], axis=1)
        points = rays * z[:, None] @ T_wc[:3, :3].numpy().T + T_wc[:3, 3].numpy()
        for point, colour in zip(points, image.numpy()[:, v, u].T, strict=True):
            voxels.setdefault(tuple(np.floor(point / 0.05).astype(int)), []).append(np.r_[point, colour])
    fused = fuse_points(views, config(voxel_size=0.05, max_depth=1.7))
    # Rounding moves a few points to the next voxel.
    assert len(voxels) > 500 and abs(len(fused) - len(voxels)) <= 3
    expected = np.array([np.mean(rows, axis=0) for rows in voxels.values()])
    distance = torch.cdist(fused.points.double(), torch.from_numpy(expected[:, :3]))
    nearest, row = distance.min(dim=1)
    assert (nearest < 1e-4).double().mean() > 0.99
    close = (fused.colours.double() - torch.from_numpy(expected[:, 3:])[row]).abs().max(dim=1).values < 0.51
    assert close.double().mean() > 0.99


def around(count: int) -> StaticViews:
    """Views of the room and the crate in all directions."""
    return views_of(*((invert(T_wc), render(T_wc, CRATE)) for T_wc in looking_around(count)), stride=2)


def test_points_lie_on_the_observed_surfaces() -> None:
    fused = fuse_points(around(8), config())
    assert len(fused) > 50_000
    error = distance_to(fused.points.double(), CRATE)
    # In a voxel with an edge of the room the mean is off the surface.
    assert error.median() < 1e-4 and (error < 1e-3).double().mean() > 0.98 and error.max() < 0.01


def test_points_are_equal_for_any_batch_size(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = fuse_points(around(6), config())
    monkeypatch.setattr(point_map_module, "_BATCH", 1)
    parts = fuse_points(around(6), config())
    assert abs(len(parts) - len(whole)) < 0.001 * len(whole)  # except for means on voxel boundaries
    assert torch.cdist(parts.points[:2000].double(), whole.points.double()).amin(dim=1).quantile(0.99) < 1e-5


def test_points_move_with_the_poses_of_their_keyframes() -> None:
    own = keyframe()
    views = StaticViews(CAMERA, 4)
    views.add(own, GREY, wall(2.0), ALL)
    before = fuse_points(views, config(voxel_size=1e-3))
    torch.testing.assert_close(before.points[:, 2], torch.full((58 * 78,), 2.0))
    own.T_cw = invert(se3_exp(torch.tensor([0.0, 0, 0.5, 0, 0, 0], dtype=torch.float64)))
    after = fuse_points(views, config(voxel_size=1e-3))
    torch.testing.assert_close(after.points[:, 2], torch.full((58 * 78,), 2.5))


def test_map_without_views_or_static_pixels_is_empty() -> None:
    views = StaticViews(CAMERA, 2)
    for _ in range(2):
        fused = fuse_points(views, config())
        assert fused.points.shape == fused.colours.shape == fused.normals.shape == (0, 3)
        views.add(keyframe(), GREY, wall(1.0), ~ALL)


def test_normals_of_the_map_equal_the_normals_of_the_room() -> None:
    fused = fuse_points(around(8), config())
    lengths = fused.normals.norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))
    # Normals point into the room: to the left at the right wall, and so on; y points down.
    for axis, place, sign in ((0, 1.49, -1), (0, -1.53, 1), (2, 1.83, -1), (2, -1.47, 1), (1, 0.41, -1)):
        on = (fused.points[:, axis] - place).abs() < 1e-3
        corners = torch.cat([ROOM, CRATE])
        for other in {0, 1, 2} - {axis}:
            on &= ((fused.points[:, other, None] - corners[:, other]).abs() > 0.1).all(dim=1)
        assert on.sum() > 200, (axis, place)
        along = sign * fused.normals[on, axis]
        assert along.min() > 0.97 and along.mean() > 0.999


# --- free space


def square_at(z: float, behind: float = 2.5) -> Tensor:
    """Depth image of a wall and of a square of 0.4 m in front of it."""
    depth = wall(behind)
    half = round(0.2 / z * CAMERA.fx)
    depth[0, 120 - half : 120 + half, 160 - half : 160 + half] = z
    return depth


def aside(x: float) -> Tensor:
    """``T_cw`` of a camera x metres to the right, without rotation."""
    return se3_exp(torch.tensor([-x, 0, 0, 0, 0, 0], dtype=torch.float64))


def count_in_front_of_the_wall(fused: PointMap) -> int:
    return int((fused.points[:, 2] < 2.3).sum())


def test_object_in_one_view_is_removed_if_another_view_observes_free_space() -> None:
    transient = (EYE, square_at(1.5))
    assert count_in_front_of_the_wall(fuse_points(views_of(transient), config())) > 1000
    assert count_in_front_of_the_wall(fuse_points(views_of(transient, (aside(0.1), wall(2.5))), config())) == 0
    assert count_in_front_of_the_wall(fuse_points(views_of((aside(0.1), wall(2.5)), transient), config())) == 0


def test_object_in_most_views_is_kept() -> None:
    """For example with a single wrong depth image."""
    present, absent = (EYE, square_at(1.5)), (EYE, wall(2.5))
    assert count_in_front_of_the_wall(fuse_points(views_of(present, present, absent), config())) > 1000
    assert count_in_front_of_the_wall(fuse_points(views_of(present, absent, absent), config())) == 0


def test_object_that_the_newest_views_do_not_observe_is_removed() -> None:
    """For example a chair that is taken away at the end; if it is put back, it is in the map."""
    present, absent = (EYE, square_at(1.5)), (EYE, wall(2.5))
    taken_away = [*5 * [present], *3 * [absent]]
    assert count_in_front_of_the_wall(fuse_points(views_of(*taken_away), config())) == 0
    assert count_in_front_of_the_wall(fuse_points(views_of(*taken_away[:-1]), config())) > 1000
    assert count_in_front_of_the_wall(fuse_points(views_of(*taken_away, present), config())) > 1000


def test_occluded_or_unmeasured_object_is_kept() -> None:
    present = (EYE, square_at(1.5))
    for depth in (wall(0.8), wall(0.0)):
        assert count_in_front_of_the_wall(fuse_points(views_of(present, *3 * [(EYE, depth)]), config())) > 1000


def test_static_room_loses_no_points() -> None:
    """Including surfaces at grazing angles and corners."""
    views = around(12)
    kept = fuse_points(views, config())
    every = fuse_points(views, load_config(overrides=["objects.free_space.min_tolerance=100"]))
    assert len(kept) > 0.999 * len(every)


def test_map_is_the_same_if_each_view_checks_all_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the bit; a view observes a small part of the map."""
    step = se3_exp(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    moved = torch.linalg.matrix_power(step, 3)
    present = [(moved @ invert(T_wc), render(T_wc, CRATE)) for T_wc in looking_around(8)]
    absent = [(moved @ invert(T_wc), render(T_wc)) for T_wc in looking_around(8, seed=1)]
    views = views_of(*present, *absent, (EYE, square_at(1.5)), (aside(0.1), wall(2.5)), stride=2)
    culled, checked = fuse_points(views, config()), list[int]()

    def all_points(blocks: PointBlocks, *_: object) -> Tensor:
        checked.append(len(blocks._order))
        return torch.arange(checked[-1])

    monkeypatch.setattr(PointBlocks, "observable_by", all_points)
    whole = fuse_points(views, config())
    assert len(checked) == len(views) and len(whole) > 1000
    for name in ("points", "colours", "normals"):
        assert torch.equal(getattr(culled, name), getattr(whole, name)), name
