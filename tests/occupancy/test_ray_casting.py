"""Ray casting against brute force, and its properties; the kernel gives the same as the torch function."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.kernels.voxel_blocks import FREE, HIT, SIDE
from v3d_torch.occupancy.ray_casting import Observations, observe_voxels

CAMERA = PinholeCamera(fx=7.0, fy=7.0, cx=3.5, cy=2.5, width=8, height=6)
VOXEL, MAX_DEPTH, TOLERANCE = 0.1, 1.5, 0.01
TWIN = TWINS["v3d_torch.occupancy.ray_casting.observe_voxels"]
IMPLEMENTATIONS = [
    pytest.param(TWIN.torch, id="torch"),
    pytest.param(
        TWIN.compiled, id="compiled", marks=pytest.mark.skipif(not compiler.ENABLED, reason="no compiled kernels")
    ),
]

poses = st.lists(st.floats(-2, 2), min_size=6, max_size=6).map(
    lambda xi: se3_exp(torch.tensor(xi, dtype=torch.float64))
)
seeds = st.integers(0, 2**31)


def random_view(seed: int) -> tuple[Tensor, Tensor]:
    """Depth with edges, holes and far pixels, and a static mask."""
    generator = torch.Generator().manual_seed(seed)
    shape = (CAMERA.height, CAMERA.width)
    depth = 0.3 + 1.6 * torch.rand(shape, generator=generator)
    depth[torch.rand(shape, generator=generator) < 0.15] = 0.0
    return depth, torch.rand(shape, generator=generator) < 0.8


def observe(
    depth: Tensor, static: Tensor, T_wc: Tensor, function: Callable[..., Observations] = observe_voxels
) -> dict:
    """Observed voxels with their marks."""
    found = function(depth, static, CAMERA.rays, T_wc, VOXEL, MAX_DEPTH, TOLERANCE)
    marks = found.marks.reshape(-1, SIDE, SIDE, SIDE)
    rows = torch.nonzero(marks)
    voxels = found.blocks[rows[:, 0]] * SIDE + rows[:, 1:]
    return dict(zip(map(tuple, voxels.tolist()), marks[tuple(rows.T)].tolist(), strict=True))


def free_depth(depth: np.ndarray, row: int, column: int) -> float:
    around = depth[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    nearest = around[around > 0].min()
    return min(nearest - VOXEL / 2 - TOLERANCE * nearest**2, MAX_DEPTH)


def observe_by_brute_force(depth: Tensor, static: Tensor, T_wc: Tensor) -> tuple[dict, set]:
    """Intersect each ray with each voxel; also return the voxels in which rounding decides."""
    depths, R, t = depth.double().numpy(), T_wc[:3, :3].numpy(), T_wc[:3, 3].numpy()
    lowest = np.floor(t / VOXEL).astype(int) - 21
    low = (lowest + np.stack(np.meshgrid(*3 * [np.arange(43)], indexing="ij"), axis=-1).reshape(-1, 3)) * VOXEL
    marks: dict = {}
    close = set()
    for row, column in zip(*np.nonzero(depths), strict=True):
        ray = R @ CAMERA.rays[row, column].double().numpy()
        sides = np.stack([(low - t) / ray, (low + VOXEL - t) / ray])
        enter, leave = sides.min(axis=0).max(axis=1).clip(0), sides.max(axis=0).min(axis=1)
        limit = free_depth(depths, row, column)
        for index in np.flatnonzero((leave - enter > 1e-9) & (leave <= limit)):
            marks.setdefault(tuple(np.rint(low[index] / VOXEL).astype(int)), FREE)
        for index in np.flatnonzero((abs(leave - enter) <= 1e-9) | (abs(leave - limit) < 1e-9)):
            close.add(tuple(np.rint(low[index] / VOXEL).astype(int)))
    for row, column in zip(*np.nonzero((depths > 0) & (depths <= MAX_DEPTH) & static.numpy()), strict=True):
        point = R @ CAMERA.rays[row, column].double().numpy() * depths[row, column] + t
        marks[tuple(np.floor(point / VOXEL).astype(int))] = HIT
    return marks, close


@pytest.mark.parametrize("function", IMPLEMENTATIONS)
@pytest.mark.parametrize("seed", range(2))
def test_marks_equal_brute_force(function: Callable[..., Observations], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    T_wc = se3_exp(2 * torch.randn(6, generator=generator, dtype=torch.float64))
    depth, static = random_view(seed)
    found = observe(depth, static, T_wc, function)
    expected, close = observe_by_brute_force(depth, static, T_wc)
    assert len(expected) > 100 and {FREE, HIT} == set(expected.values())
    different = {voxel for voxel in found.keys() | expected.keys() if found.get(voxel) != expected.get(voxel)}
    assert different <= close


@pytest.mark.parametrize("function", IMPLEMENTATIONS)
def test_rays_along_the_axes_and_voxel_boundaries_are_cast(function: Callable[..., Observations]) -> None:
    """From a corner of voxels, one ray runs along an edge of voxels."""
    camera = PinholeCamera(fx=10.0, fy=10.0, cx=1.0, cy=1.0, width=3, height=3)
    depth = torch.full((3, 3), 1.0)
    ones = torch.ones(3, 3, dtype=torch.bool)
    found = function(depth, ones, camera.rays, torch.eye(4, dtype=torch.float64), 0.125, 2.0, 0.0)
    marks = found.marks.reshape(-1, SIDE, SIDE, SIDE)
    origin = int(torch.nonzero((found.blocks == 0).all(dim=1))[0, 0])
    assert marks[origin, 0, 0].tolist() == [FREE] * 7 + [0, HIT] + [0] * 7


@pytest.mark.skipif(not compiler.ENABLED, reason="no compiled kernels")
@settings(max_examples=40)
@given(pose=poses, seed=seeds)
def test_kernel_equals_torch_exactly(pose: Tensor, seed: int) -> None:
    arguments = (*random_view(seed), CAMERA.rays, pose, VOXEL, MAX_DEPTH, TOLERANCE)
    found, expected = TWIN.compiled(*arguments), TWIN.torch(*arguments)
    assert torch.equal(found.blocks, expected.blocks) and torch.equal(found.marks, expected.marks)


@settings(max_examples=40)
@given(pose=poses, seed=seeds)
def test_blocks_are_unique_and_ascending(pose: Tensor, seed: int) -> None:
    found = observe_voxels(*random_view(seed), CAMERA.rays, pose, VOXEL, MAX_DEPTH, TOLERANCE)
    assert torch.equal(found.blocks, found.blocks.unique(dim=0))
    assert (found.marks > 0).any(dim=1).all()


@settings(max_examples=40)
@given(pose=poses, seed=seeds, fraction=st.floats(0, 0.95))
def test_point_that_is_seen_through_is_free_or_holds_another_surface(pose: Tensor, seed: int, fraction: float) -> None:
    depth, static = random_view(seed)
    marks = observe(depth, static, pose)
    hits = {voxel for voxel, mark in marks.items() if mark == HIT}
    for row, column in torch.nonzero(depth)[::7].tolist():
        end = free_depth(depth.double().numpy(), row, column) - VOXEL * 3**0.5  # so that the ray leaves the voxel
        point = pose[:3, :3] @ CAMERA.rays[row, column].double() * fraction * end + pose[:3, 3]
        voxel = tuple((point / VOXEL).floor().int().tolist())
        assert end <= 0 or marks[voxel] == FREE or voxel in hits


@settings(max_examples=40)
@given(pose=poses, seed=seeds)
def test_moving_surfaces_are_not_hit_and_hide_what_is_behind(pose: Tensor, seed: int) -> None:
    depth, _ = random_view(seed)
    marks = observe(depth, torch.zeros_like(depth, dtype=torch.bool), pose)
    assert HIT not in marks.values()
    centres = torch.tensor(list(marks)).double().add(0.5).mul(VOXEL)
    reach = (centres - pose[:3, 3]).norm(dim=1)
    farthest = float(depth.clamp(max=MAX_DEPTH).max()) * float(CAMERA.rays.norm(dim=-1).max())
    assert reach.max() < farthest + VOXEL


def test_surfaces_beyond_the_maximum_depth_are_not_hit_but_show_free_space() -> None:
    depth = torch.full((CAMERA.height, CAMERA.width), 5.0)
    marks = observe(depth, torch.ones_like(depth, dtype=torch.bool), torch.eye(4, dtype=torch.float64))
    assert set(marks.values()) == {FREE}
    farthest = max(z for _, _, z in marks)
    assert MAX_DEPTH - 2.5 * VOXEL < farthest * VOXEL < MAX_DEPTH - VOXEL / 2


def test_rays_beside_an_edge_end_at_the_nearer_surface() -> None:
    depth = torch.full((CAMERA.height, CAMERA.width), 1.4)
    depth[:, :4] = 0.5
    marks = observe(depth, torch.ones_like(depth, dtype=torch.bool), torch.eye(4, dtype=torch.float64))
    at_edge = CAMERA.rays[3, 4].double()
    behind = tuple((at_edge * 1.0 / VOXEL).floor().int().tolist())
    aside = tuple((CAMERA.rays[3, 6].double() * 1.0 / VOXEL).floor().int().tolist())
    assert behind not in marks and marks[aside] == FREE


def test_view_without_depth_observes_nothing() -> None:
    depth = torch.zeros(CAMERA.height, CAMERA.width)
    for implementation in (TWIN.torch, observe_voxels):
        found = implementation(depth, depth == 0, CAMERA.rays, torch.eye(4).double(), VOXEL, MAX_DEPTH, TOLERANCE)
        assert found.blocks.shape == (0, 3) and found.marks.shape == (0, SIDE**3)


@pytest.mark.parametrize("function", IMPLEMENTATIONS)
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf, -1.0])
def test_invalid_depth_counts_as_missing(function: Callable[..., Observations], bad: float) -> None:
    depth, static = random_view(3)
    T_wc = se3_exp(torch.tensor([0.1, -0.2, 0.3, 0.2, 0.1, -0.3], dtype=torch.float64))
    expected = observe(depth, static, T_wc, function)
    assert observe(torch.where(depth > 0, depth, bad), static, T_wc, function) == expected


@pytest.mark.parametrize("name", ["depth", "static", "rays", "T_wc"])
def test_inputs_of_other_shapes_are_rejected(name: str) -> None:
    depth, static = random_view(3)
    inputs = {"depth": depth, "static": static, "rays": CAMERA.rays, "T_wc": torch.eye(4, dtype=torch.float64)}
    inputs[name] = inputs[name][:-1]
    with pytest.raises(ShapeError):
        observe_voxels(**inputs, voxel_size=VOXEL, max_depth=MAX_DEPTH, tolerance=TOLERANCE)
