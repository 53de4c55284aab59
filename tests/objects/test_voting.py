"""Hough voting against Algorithm 1 of the paper, implemented literally with dictionaries."""

from __future__ import annotations

import math
from collections import defaultdict

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.config import VotingConfig
from v3d_torch.errors import ConfigError
from v3d_torch.objects.voting import HoughVoting, hough_vote, vote_with_free_space

Objects = dict[str, tuple[float, float, float]]


def pairwise_center_dist(objects: Objects) -> dict[tuple[str, str], float]:
    """Return all pairwise distances; the first object of a key is the one that gets the vote."""
    return {(i, j): math.dist(objects[i], objects[j]) for i in objects for j in objects if i != j}


def algorithm_1(previous: Objects, current: Objects, T_d: float, T_v: int) -> tuple[dict[str, int], set[str]]:
    """Return the accumulator and the dynamic objects."""
    dist_p, dist_c = pairwise_center_dist(previous), pairwise_center_dist(current)
    accumulator: dict[str, int] = defaultdict(int)
    for k_p in dist_p:
        for k_c in dist_c:
            if k_p == k_c and abs(dist_p[k_p] - dist_c[k_c]) >= T_d:
                accumulator[k_c[0]] += 1
    return accumulator, {key for key, votes in accumulator.items() if votes >= T_v}


def scene(count: int, moving: list[int], by: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return the centroids of objects from two camera poses; some have moved ``by`` metres along x."""
    generator = torch.Generator().manual_seed(seed)
    world = 3 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    moved = world.clone()
    moved[moving, 0] += by
    turn = torch.from_numpy(Rotation.from_rotvec([0.1, -0.4, 0.2]).as_matrix())
    return world, moved @ turn.T + torch.tensor([0.5, 0.1, -0.3], dtype=torch.float64)


@settings(max_examples=100)
@given(
    names=st.lists(st.sampled_from("abcdefgh"), unique=True),
    data=st.data(),
    T_v=st.integers(1, 4),
)
def test_votes_equal_algorithm_1(names: list[str], data: st.DataObject, T_v: int) -> None:
    frames: list[Objects] = []
    present_in = []
    for _ in range(2):
        present_in.append(data.draw(st.lists(st.booleans(), min_size=len(names), max_size=len(names))))
        centroid = st.tuples(*[st.integers(-3, 3).map(float)] * 3)
        frames.append(
            {name: data.draw(centroid) for name, is_present in zip(names, present_in[-1], strict=True) if is_present}
        )
    nowhere = (math.nan,) * 3
    rows = [torch.tensor([f.get(name, nowhere) for name in names], dtype=torch.float64).reshape(-1, 3) for f in frames]
    present = torch.tensor(present_in[0], dtype=torch.bool) & torch.tensor(present_in[1], dtype=torch.bool)
    result = hough_vote(*rows, present, distance_threshold=0.3, vote_threshold=T_v)
    accumulator, dynamic = algorithm_1(*frames, T_d=0.3, T_v=T_v)
    assert result.votes.tolist() == [accumulator[name] for name in names]
    assert result.dynamic.tolist() == [name in dynamic for name in names]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_moving_object_is_dynamic_without_the_pose(dtype: torch.dtype) -> None:
    previous, current = (frame.to(dtype) for frame in scene(6, [2], by=0.8))
    result = hough_vote(previous, current, torch.ones(6, dtype=torch.bool), 0.02, vote_threshold=2)
    assert result.votes.dtype == dtype
    assert result.dynamic.tolist() == [False, False, True, False, False, False]
    assert result.votes[2] == 5 and (result.votes[[0, 1, 3, 4, 5]] == 1).all()
    still = result.change[[0, 1, 3, 4, 5]][:, [0, 1, 3, 4, 5]]
    assert still.max() < 1e-5


def test_convention_thresholds_are_reached_at_equality() -> None:
    previous = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    current = torch.tensor([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]])
    result = HoughVoting(distance_threshold=0.5, vote_threshold=1)(previous, current, torch.ones(2, dtype=torch.bool))
    assert result.dynamic.all()
    assert result.change.tolist() == [[0.0, 0.5], [0.5, 0.0]]


def test_batch_dimensions_and_absent_rows_equal_single_votes() -> None:
    frames = [scene(5, [k], by=0.7, seed=k) for k in range(4)]
    previous = torch.stack([p for p, _ in frames]).reshape(2, 2, 5, 3)
    current = torch.stack([c for _, c in frames]).reshape(2, 2, 5, 3)
    present = torch.rand(2, 2, 5, generator=torch.Generator().manual_seed(0)) < 0.8
    previous[~present] = torch.nan
    result = hough_vote(previous, current, present, 0.02, 2)
    assert result.pair.shape == result.change.shape == (2, 2, 5, 5)
    for i in range(2):
        for j in range(2):
            rows = present[i, j]
            alone = hough_vote(
                previous[i, j, rows], current[i, j, rows], torch.ones(rows.sum(), dtype=torch.bool), 0.02, 2
            )
            torch.testing.assert_close(result.votes[i, j, rows], alone.votes)
            assert torch.equal(result.dynamic[i, j, rows], alone.dynamic)
    assert not result.votes[~present].any() and not result.dynamic[~present].any()
    assert not result.change.isnan().any()


def test_permutation_of_objects_permutes_the_votes() -> None:
    previous, current = scene(7, [1, 4], by=0.6)
    order = torch.randperm(7, generator=torch.Generator().manual_seed(5))
    all_present = torch.ones(7, dtype=torch.bool)
    votes = hough_vote(previous, current, all_present, 0.05, 2).votes
    assert torch.equal(hough_vote(previous[order], current[order], all_present, 0.05, 2).votes, votes[order])


def test_soft_vote_converges_to_hard_vote() -> None:
    previous, current = scene(6, [0, 3], by=0.9)
    all_present = torch.ones(6, dtype=torch.bool)
    hard = hough_vote(previous, current, all_present, 0.05, 2)
    soft = hough_vote(previous, current, all_present, 0.05, 2, temperature=1e-5)
    torch.testing.assert_close(soft.votes, hard.votes, atol=1e-3, rtol=0.0)
    at_threshold = hough_vote(previous, current, all_present, float(hard.change[0, 1]), 2, temperature=0.1)
    assert at_threshold.pair[0, 1] == pytest.approx(0.5)
    assert not at_threshold.pair.diagonal().any()  # no object votes for itself


@pytest.mark.parametrize("temperature", [0, -0.1, math.nan])
def test_temperature_that_is_not_positive_is_an_error(temperature: float) -> None:
    """A change that equals the threshold would be 0 / 0."""
    previous, current = scene(3, [1], by=0.5)
    with pytest.raises(ConfigError, match=r"^hough_vote: temperature is .*; give a number above 0, or None$"):
        hough_vote(previous, current, torch.ones(3, dtype=torch.bool), 0.05, 2, temperature=temperature)


def test_gradients_are_correct_and_finite_with_absent_objects() -> None:
    previous, current = (frame.requires_grad_() for frame in scene(5, [1], by=0.5))
    present = torch.tensor([True, True, True, True, False])

    def soft(p: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        result = hough_vote(p, c, present, 0.1, 2, temperature=0.05)
        return result.votes, result.pair

    # Only the changed distances: at a change of 0 the absolute value has a kink.
    assert torch.autograd.gradcheck(lambda p, c: soft(p, c)[1][1, [0, 2, 3]], (previous, current))

    with torch.no_grad():
        previous[4] = torch.nan
        previous[3] = previous[2]
    soft(previous, current)[0].sum().backward()
    assert previous.grad is not None and previous.grad.isfinite().all()


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_objects_have_no_votes(count: int) -> None:
    result = hough_vote(torch.rand(count, 3), torch.rand(count, 3), torch.ones(count, dtype=torch.bool), 0.1, 1)
    assert result.votes.tolist() == [0.0] * count and not result.dynamic.any()


@pytest.mark.parametrize(
    ("previous", "current", "present"),
    [((5, 2), (5, 3), (5,)), ((5, 3), (5, 2), (5,)), ((5, 3), (4, 3), (5,)), ((5, 3), (5, 3), (4,)), ((3,), (3,), ())],
)
def test_wrong_shapes_are_rejected(
    previous: tuple[int, ...], current: tuple[int, ...], present: tuple[int, ...]
) -> None:
    with pytest.raises(ShapeError):
        hough_vote(torch.zeros(previous), torch.zeros(current), torch.ones(present, dtype=torch.bool), 0.1, 1)


def test_module_uses_the_temperature() -> None:
    previous, current = scene(5, [1], by=0.5)
    all_present = torch.ones(5, dtype=torch.bool)
    for temperature in (None, 0.05, 0.2):
        module = HoughVoting(0.1, 2, temperature)(previous, current, all_present)
        assert torch.equal(module.votes, hough_vote(previous, current, all_present, 0.1, 2, temperature).votes)
    assert not torch.equal(module.votes, hough_vote(previous, current, all_present, 0.1, 2).votes)


def test_thresholds_of_a_batch_belong_to_its_problems() -> None:
    """They were compared with the objects, of which there can be as many."""
    previous = torch.rand(3, 3, 3, generator=torch.Generator().manual_seed(0))
    current = previous + 0.1 * torch.rand(3, 3, 3, generator=torch.Generator().manual_seed(1))
    present = torch.ones(3, 3, dtype=torch.bool)
    thresholds = torch.tensor([0.0, 0.05, 10.0]), torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.01, 0.1, 0.2])
    for settings_of_batch in (thresholds[:2], thresholds):
        together = hough_vote(previous, current, present, *settings_of_batch)
        for k in range(3):
            numbers = (each[k] for each in settings_of_batch)
            one = hough_vote(previous[k], current[k], present[k], *numbers)
            assert all(torch.equal(batch[k], single) for batch, single in zip(together, one, strict=True))


@pytest.mark.parametrize("name", ["distance_threshold", "vote_threshold", "temperature"])
@pytest.mark.parametrize("shape", [(3,), (2, 1, 1), (2, 3)])
def test_threshold_that_does_not_fit_the_batch_is_an_error(name: str, shape: tuple[int, ...]) -> None:
    centroids, present = torch.zeros(2, 3, 3), torch.ones(2, 3, dtype=torch.bool)
    arguments = {"distance_threshold": 0.1, "vote_threshold": 2, "temperature": 0.1} | {name: torch.ones(shape)}
    with pytest.raises(ShapeError, match=f"^{name} has the shape .* of shape \\(2\\)$"):
        hough_vote(centroids, centroids, present, **arguments)  # type: ignore[arg-type]


def test_threshold_that_is_a_tensor_moves_with_the_module() -> None:
    module = HoughVoting(torch.tensor(0.1), torch.tensor(2), torch.nn.Parameter(torch.tensor(0.05)))
    assert set(module.state_dict()) == {"distance_threshold", "vote_threshold", "temperature"}
    assert dict(module.named_parameters()).keys() == {"temperature"}
    moved = module.to("meta")
    assert moved.distance_threshold.is_meta and moved.vote_threshold.is_meta


def test_text_of_the_module_has_its_settings() -> None:
    module = HoughVoting(torch.nn.Parameter(torch.tensor(0.5)), 2)
    assert repr(module) == "HoughVoting(distance_threshold=0.5, vote_threshold=2, temperature=None)"


@pytest.mark.parametrize("is_checked", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_votes_with_free_space_of_a_batch_are_those_of_each_problem_alone(seed: int, is_checked: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    previous = torch.rand(4, 7, 3, generator=generator, dtype=torch.float64)
    current = previous + 0.05 * torch.randn(4, 7, 1, generator=generator, dtype=torch.float64)
    present = torch.rand(4, 7, generator=generator) < torch.tensor([1.0, 0.7, 0.2, 0.0])[:, None]
    moved = torch.rand(4, 7, generator=generator) < 0.5
    together = vote_with_free_space(previous, current, moved if is_checked else None, VotingConfig(), present)
    for k, rows in enumerate(present):
        alone = vote_with_free_space(
            previous[k, rows], current[k, rows], moved[k, rows] if is_checked else None, VotingConfig()
        )
        for found, expected in zip(together, alone, strict=True):
            others = found[k].clone()
            others[torch.meshgrid(*[rows.nonzero()[:, 0]] * expected.ndim, indexing="ij")] = 0
            assert not others.any()
            assert torch.equal(found[k][rows][..., rows] if expected.ndim == 2 else found[k][rows], expected)
