"""Files of OctoMap, read back by octomap-python and by a reader written from the format's description."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from helpers.occupancy_scenes import CONFIG, box_of_voxels, map_of, map_of_room
from torch import Tensor

from v3d_torch.config import OccupancyConfig
from v3d_torch.errors import OutputError
from v3d_torch.kernels.voxel_blocks import UNKNOWN
from v3d_torch.occupancy import voxel_blocks
from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState
from v3d_torch.occupancy.octomap_file import write_octomap

NONE = torch.zeros(0, 3, dtype=torch.int64)


@pytest.fixture
def octomap() -> ModuleType:
    return pytest.importorskip("octomap", reason="octomap-python is not installed (pip install octomap-python)")


@pytest.fixture(scope="module")
def room() -> OccupancyMap:
    return map_of_room(views=8)


def read(path: Path) -> tuple[dict[str, str], dict[tuple[int, ...], int]]:
    """Read header and leaves of a file: state of each leaf by its lowest voxel and its side in voxels."""
    header, data = path.read_bytes().split(b"\ndata\n", 1)
    fields = dict(line.split(" ", 1) for line in header.decode().splitlines() if not line.startswith("#"))
    words = iter(np.frombuffer(data, "<u2").tolist())
    leaves: dict[tuple[int, ...], int] = {}
    nodes = 1

    def visit(low: tuple[int, ...], side: int) -> None:
        nonlocal nodes
        word, inner = next(words), []
        for child in range(8):
            state, half = (word >> 2 * child) & 3, side // 2
            corner = tuple(low[axis] + half * (child >> axis & 1) for axis in range(3))
            nodes += state > 0
            if state == 3:
                inner.append((corner, half))
            elif state:
                leaves[(*corner, half)] = VoxelState.FREE if state == 1 else VoxelState.OCCUPIED
        for corner, half in inner:
            visit(corner, half)

    if data:
        visit(3 * (-(1 << 15),), 1 << 16)
    assert next(words, None) is None and (not data or nodes == int(fields["size"]))
    return fields, leaves


def voxels_of(leaves: dict[tuple[int, ...], int]) -> dict[tuple[int, ...], int]:
    return {
        tuple(voxel): state
        for (x, y, z, side), state in leaves.items()
        for voxel in box_of_voxels((x, y, z), (x + side, y + side, z + side)).tolist()
    }


def expected_voxels(occupied: Tensor, free: Tensor) -> dict[tuple[int, ...], int]:
    states = {tuple(voxel): int(VoxelState.FREE) for voxel in free.tolist()}
    return states | {tuple(voxel): int(VoxelState.OCCUPIED) for voxel in occupied.tolist()}


@pytest.mark.parametrize("seed", range(4))
def test_leaves_are_the_known_voxels(seed: int, tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(seed)
    voxels = torch.randint(-30, 30, (300, 3), generator=generator).unique(dim=0)
    is_occupied = torch.rand(len(voxels), generator=generator) < 0.3
    occupied, free = voxels[is_occupied], voxels[~is_occupied]
    write_octomap(tmp_path / "map.bt", map_of(occupied, free))
    fields, leaves = read(tmp_path / "map.bt")
    assert voxels_of(leaves) == expected_voxels(occupied, free)
    assert fields["id"] == "OcTree" and float(fields["res"]) == CONFIG.voxel_size


def test_resolution_is_the_voxel_size_with_all_digits(tmp_path: Path) -> None:
    write_octomap(tmp_path / "map.bt", map_of(NONE, NONE, OccupancyConfig(voxel_size=1 / 30)))
    assert float(read(tmp_path / "map.bt")[0]["res"]) == 1 / 30


def test_voxel_with_probability_one_half_is_occupied_in_map_and_file(tmp_path: Path) -> None:
    occupancy = map_of(torch.tensor([[1, 2, 3]]), NONE)
    log_odds = occupancy.blocks.log_odds
    log_odds[log_odds != UNKNOWN] = 0
    write_octomap(tmp_path / "map.bt", occupancy)
    assert len(occupancy.occupied_points) == 1
    assert read(tmp_path / "map.bt")[1] == {(1, 2, 3, 1): VoxelState.OCCUPIED}


def test_children_of_one_state_are_merged(tmp_path: Path) -> None:
    occupied, free = box_of_voxels((-8, -8, -8), (0, 0, 0)), box_of_voxels((0, 0, 0), (16, 16, 16))
    write_octomap(tmp_path / "map.bt", map_of(occupied, free))
    _, leaves = read(tmp_path / "map.bt")
    assert leaves == {(-8, -8, -8, 8): VoxelState.OCCUPIED, (0, 0, 0, 16): VoxelState.FREE}


def test_empty_map_is_a_file_without_nodes(tmp_path: Path, octomap: ModuleType) -> None:
    write_octomap(tmp_path / "map.bt", OccupancyMap(CONFIG))
    assert read(tmp_path / "map.bt")[1] == {}
    assert octomap.OcTree(str(tmp_path / "map.bt").encode()).size() == 0


def test_octomap_reads_back_every_voxel(room: OccupancyMap, tmp_path: Path, octomap: ModuleType) -> None:
    write_octomap(tmp_path / "map.bt", room)
    tree = octomap.OcTree(str(tmp_path / "map.bt").encode())
    assert tree.getResolution() == CONFIG.voxel_size and tree.size() > 1000
    for points, state in ((room.occupied_points, 1), (room.free_points, 0)):
        assert (tree.getLabels(points.numpy()) == state).all()
    known = sum((1 << 3 * (16 - node.getDepth())) for node in tree.begin_leafs())
    assert known == len(room.occupied_points) + len(room.free_points)


def test_octomap_casts_a_ray_to_the_wall(room: OccupancyMap, tmp_path: Path, octomap: ModuleType) -> None:
    write_octomap(tmp_path / "map.bt", room)
    tree, end = octomap.OcTree(str(tmp_path / "map.bt").encode()), np.zeros(3)
    # Space close to the wall, within the depth error, is unknown.
    assert tree.castRay(np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 1.0]), end, True, 5.0)
    assert end[2] == pytest.approx(1.83, abs=CONFIG.voxel_size)


def test_map_larger_than_an_octree_is_rejected(tmp_path: Path) -> None:
    for far in (1 << 15, -(1 << 15) - 1):
        occupancy = map_of(torch.tensor([[far, 0, 0]]), NONE, OccupancyConfig())
        with pytest.raises(OutputError, match=r"map\.bt: the map is larger than an OctoMap of 1638 m"):
            write_octomap(tmp_path / "map.bt", occupancy)
    write_octomap(tmp_path / "map.bt", map_of(torch.tensor([[(1 << 15) - 1, 0, -(1 << 15)]]), NONE))
    assert len(read(tmp_path / "map.bt")[1]) == 1


def test_file_does_not_depend_on_the_size_of_the_parts(
    room: OccupancyMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_octomap(tmp_path / "whole.bt", room)
    monkeypatch.setattr(voxel_blocks, "_CHUNK_BLOCKS", 1)
    write_octomap(tmp_path / "parts.bt", room)
    assert (tmp_path / "parts.bt").read_bytes() == (tmp_path / "whole.bt").read_bytes()
