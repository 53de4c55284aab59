"""Blocks of voxels against a dictionary of voxels."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.config import OccupancyConfig
from v3d_torch.geometry.cell_keys import MAX_COORDINATE
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.kernels.voxel_blocks import BITS, HIT, SIDE, UNKNOWN, VOLUME
from v3d_torch.occupancy.ray_casting import Observations
from v3d_torch.occupancy.sensor_model import SensorModel
from v3d_torch.occupancy.voxel_blocks import VoxelBlocks

MODEL = SensorModel.from_config(OccupancyConfig())


def random_observations(generator: torch.Generator) -> Observations:
    blocks = torch.randint(-3, 3, (5, 3), generator=generator).unique(dim=0)
    blocks = blocks[torch.randperm(len(blocks), generator=generator)]
    return Observations(blocks, torch.randint(0, 3, (len(blocks), VOLUME), generator=generator, dtype=torch.uint8))


@settings(max_examples=10)
@given(seed=st.integers(0, 2**31), views=st.integers(1, 6))
def test_log_odds_equal_those_of_single_voxels(seed: int, views: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    blocks, expected = VoxelBlocks(), {}
    for _ in range(views):
        observations = random_observations(generator)
        blocks.add(observations, MODEL)
        for block, marks in zip(observations.blocks.tolist(), observations.marks[:, ::797].tolist(), strict=True):
            for index, mark in zip(range(0, VOLUME, 797), marks, strict=True):
                if mark:
                    x, y, z = index >> 2 * BITS, (index >> BITS) % SIDE, index % SIDE
                    voxel = (block[0] * SIDE + x, block[1] * SIDE + y, block[2] * SIDE + z)
                    change = MODEL.hit if mark == HIT else MODEL.miss
                    expected[voxel] = min(max(expected.get(voxel, 0) + change, MODEL.minimum), MODEL.maximum)
    assert blocks.log_odds_at(torch.tensor(list(expected))).tolist() == list(expected.values())
    known = blocks.log_odds != UNKNOWN
    assert torch.equal(blocks.log_odds_at(blocks.voxels_where(known)), blocks.log_odds[known])


@pytest.mark.skipif(not compiler.ENABLED, reason="no compiled kernels")
def test_kernel_equals_torch_exactly() -> None:
    generator = torch.Generator().manual_seed(0)
    log_odds = torch.randint(MODEL.minimum, MODEL.maximum + 1, (6, VOLUME), generator=generator).to(torch.int8)
    log_odds[:, ::3] = UNKNOWN
    marks = torch.randint(0, 3, (3, VOLUME), generator=generator, dtype=torch.uint8)
    twin, slots = TWINS["v3d_torch.occupancy.voxel_blocks.add_observations"], torch.tensor([4, 0, 5])
    found, expected = log_odds.clone(), log_odds.clone()
    twin.compiled(found, slots, marks, MODEL)
    twin.torch(expected, slots, marks, MODEL)
    assert torch.equal(found, expected) and not torch.equal(found, log_odds)


def test_blocks_that_do_not_exist_are_unknown() -> None:
    blocks = VoxelBlocks()
    far = torch.tensor([[0, 0, 0], [MAX_COORDINATE * SIDE, 0, 0], [-(2**60), 2**60, 0]])
    assert blocks.log_odds_at(far).tolist() == 3 * [UNKNOWN]
    blocks.add(Observations(torch.zeros(1, 3, dtype=torch.int64), torch.full((1, VOLUME), HIT).to(torch.uint8)), MODEL)
    assert blocks.log_odds_at(far).tolist() == [MODEL.hit, UNKNOWN, UNKNOWN]


def test_kept_and_restored_blocks_have_the_same_log_odds() -> None:
    generator = torch.Generator().manual_seed(1)
    blocks, restored = VoxelBlocks(), VoxelBlocks()
    for _ in range(3):
        blocks.add(random_observations(generator), MODEL)
    before, mask = blocks.state_dict(), torch.arange(len(blocks)) % 2 == 0
    restored.load_state_dict(before)
    voxels = blocks.coordinates * SIDE + 3
    expected = torch.where(mask, blocks.log_odds_at(voxels), UNKNOWN)
    blocks.keep(mask)
    assert torch.equal(blocks.log_odds_at(voxels), expected)
    assert torch.equal(restored.log_odds, before["log_odds"]) and len(restored) == len(mask)


def test_blocks_are_copied_from_a_grid_in_which_twice_as_many_of_their_voxels_are_known() -> None:
    known = torch.tensor([[10, 10, 10, 0], [19, 20, 0, 5]])  # of four blocks, in each grid; 0: the block does not exist
    grids = VoxelBlocks(), VoxelBlocks()
    for grid, counts, mark in zip(grids, known, (1, HIT), strict=True):
        rows = counts.nonzero()[:, 0]
        marks = torch.where(torch.arange(VOLUME) < counts[rows, None], mark, 0).to(torch.uint8)
        grid.add(Observations(torch.stack([rows, -rows, rows], dim=1), marks), MODEL)
    own, other = grids
    own.copy_better_observed(other)
    voxels = SIDE * torch.tensor([[row, -row, row] for row in range(4)])
    assert own.log_odds_at(voxels).tolist() == [MODEL.miss, MODEL.hit, MODEL.miss, MODEL.hit]
    assert own.count_known()[own.find(voxels >> BITS)].tolist() == [10, 20, 10, 5]


def test_sensor_model_has_the_probabilities_of_the_configuration() -> None:
    config = OccupancyConfig()
    probability = torch.tensor([MODEL.hit, MODEL.miss, MODEL.minimum, MODEL.maximum], dtype=torch.float64)
    expected = [config.hit_probability, config.miss_probability, config.min_probability, config.max_probability]
    assert (probability * MODEL.step).sigmoid().tolist() == pytest.approx(expected, abs=0.005)
    assert max(-MODEL.minimum, MODEL.maximum) == 127


def test_weak_measurements_still_change_a_voxel() -> None:
    model = SensorModel.from_config(OccupancyConfig(hit_probability=0.5001, miss_probability=0.4999))
    assert (model.hit, model.miss) == (1, -1)
