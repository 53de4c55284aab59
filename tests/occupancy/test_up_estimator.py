"""The up direction comes from gravity, else from the floor, else from the segmentation, else from the first camera."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from helpers.differences import differences

from v3d_torch.errors import InputError
from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.up_direction import estimate_up
from v3d_torch.occupancy.up_estimator import UpEstimator

T_CW = se3_exp(torch.tensor([0.1, -0.2, 0.3, 0.2, 0.1, -0.4], dtype=torch.float64))
T_NEW_OLD = se3_exp(torch.tensor([0.5, 0.0, 0.0, 0.0, math.pi / 2, 0.0], dtype=torch.float64))
DOWN = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
FLOOR = Floor(torch.tensor([0.0, -0.8, -0.6], dtype=torch.float64), -1.0, 3.0)


def test_first_measured_gravity_is_kept_in_the_world_frame() -> None:
    estimator = UpEstimator()
    estimator.add_gravity(None, T_CW, None)
    assert estimator.gravity is None
    estimator.add_gravity(T_CW[:3, :3] @ DOWN, T_CW, T_NEW_OLD)
    estimator.add_gravity(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), T_CW, None)
    torch.testing.assert_close(estimator.gravity, DOWN)


def test_gravity_rotates_with_the_world_frame() -> None:
    estimator = UpEstimator()
    estimator.add_gravity(DOWN, torch.eye(4, dtype=torch.float64), None)
    estimator.add_gravity(None, T_CW, T_NEW_OLD)
    torch.testing.assert_close(estimator.gravity, T_NEW_OLD[:3, :3] @ DOWN)


@pytest.mark.parametrize("votes", [None, torch.tensor([0.0, -3.0, -4.0], dtype=torch.float64)])
def test_up_is_the_normal_of_the_floor_without_gravity(votes: torch.Tensor | None) -> None:
    estimator = UpEstimator()
    estimator.votes = votes
    assert torch.equal(estimator.up(FLOOR), FLOOR.up)
    level = estimator.T_lw(FLOOR)
    assert level is not None and torch.equal(level, level_frame(FLOOR.up))


def test_measured_gravity_is_preferred_to_the_floor() -> None:
    estimator = UpEstimator()
    estimator.add_gravity(DOWN, torch.eye(4, dtype=torch.float64), None)
    torch.testing.assert_close(estimator.up(FLOOR), -DOWN)
    level = estimator.T_lw(None)
    assert level is not None
    torch.testing.assert_close(level, level_frame(-DOWN))


def test_level_frame_needs_gravity_or_floor() -> None:
    estimator = UpEstimator()
    assert estimator.T_lw(None) is None
    assert estimator.up(None).tolist() == [0.0, -1.0, 0.0]
    estimator.votes = torch.tensor([0.0, -3.0, -4.0], dtype=torch.float64)
    assert estimator.T_lw(None) is None
    torch.testing.assert_close(estimator.up(None), torch.tensor([0.0, -0.6, -0.8], dtype=torch.float64))


def test_state_is_restored() -> None:
    estimator, restored = UpEstimator(), UpEstimator()
    estimator.add_gravity(DOWN, T_CW, None)
    estimator.votes = torch.ones(3, dtype=torch.float64)
    restored.load_state_dict(copy.deepcopy(estimator.state_dict()))
    assert list(differences(vars(restored), vars(estimator), "estimator", {})) == []
    for each in (estimator, restored):
        each.add_gravity(DOWN, torch.eye(4, dtype=torch.float64), T_CW)
    assert torch.equal(restored.up(FLOOR), estimator.up(FLOOR)) and not torch.equal(restored.up(FLOOR), FLOOR.up)


@pytest.mark.parametrize("gravity", [[0.0, 0.0, 0.0], [0.0, math.nan, 1.0], [0.0, math.inf, 1.0], [0.0, 1.0]])
def test_gravity_without_direction_is_an_input_error(gravity: list[float]) -> None:
    with pytest.raises(InputError, match=r"^gravity is \[.*\]; give a vector of 3 numbers, not zero$"):
        estimate_up(torch.tensor(gravity))
