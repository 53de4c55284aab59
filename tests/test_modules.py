"""What every module of the package promises: batches, padding, types, gradients, each with its functional form.

The numbers themselves are held to other libraries in the file of each module.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product

import pytest
import torch
from torch import Tensor

import v3d_torch as v3d
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.objects.instance_clouds import InstanceClouds

DTYPES = [torch.float32, torch.float64]
CAMERA = v3d.PinholeCamera(fx=12.0, fy=11.0, cx=4.5, cy=3.5, width=10, height=8)
Inputs = dict[str, Tensor]
Make = Callable[[int, int, torch.dtype], Inputs]


def some(*shape: int, dtype: torch.dtype, seed: int = 0) -> Tensor:
    """Numbers in [0, 1), the same each time and in every type."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def ragged(batch: int, count: int, seed: int = 1) -> Tensor:
    """A mask that leaves out a third, and all of the second row."""
    mask = some(batch, count, dtype=torch.float64, seed=seed) < 0.67
    mask[1:2] = False
    return mask


def image(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Depth of a slope with a step and holes; ``count`` has no say, the camera has."""
    shape = (batch, 1, CAMERA.height, CAMERA.width)
    depth = 1 + 0.1 * some(*shape, dtype=dtype) + (torch.arange(CAMERA.width) > 5)
    return {"depth": depth * (some(*shape, dtype=dtype, seed=2) < 0.8)}


def cloud(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    return {"points": some(batch, count, 3, dtype=dtype), "valid": ragged(batch, count)}


def clustered(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    labels = (9 * some(batch, count, dtype=torch.float64)).to(torch.int64) - 1
    return {"labels": labels, "valid": ragged(batch, count)}


def centroids(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    previous, current = (some(batch, count, 3, dtype=dtype, seed=seed) for seed in (2, 3))
    return {"previous": previous, "current": current, "present": ragged(batch, count)}


def pair(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    p, q = some(batch, count, 3, dtype=dtype), some(batch, count, 3, dtype=dtype, seed=4)
    return {"p": p, "q": q, "p_valid": ragged(batch, count), "q_valid": ragged(batch, count, 5)}


def then_and_now(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    p, q, p_valid, q_valid = pair(batch, count, dtype).values()
    T_now_then = se3_exp(0.3 * some(batch, 6, dtype=torch.float64)).to(dtype)
    return {"then": p, "now": q, "then_valid": p_valid, "now_valid": q_valid, "T_now_then": T_now_then}


@dataclass(frozen=True)
class Idea:
    """A module and its functional form, with what they take.

    Attributes:
        module: with settings.
        function: with the same settings.
        inputs: by batch size, number of elements and type.
        masks: name of the mask of each padded argument.
        differentiable: arguments with a gradient.
    """

    module: torch.nn.Module
    function: Callable[..., object]
    inputs: Make
    masks: dict[str, str]
    differentiable: tuple[str, ...] = ()


CLOUD, PAIR = {"points": "valid"}, {"p": "p_valid", "q": "q_valid"}
CENTROIDS, TWICE = {"previous": "present", "current": "present"}, {"then": "then_valid", "now": "now_valid"}
IDEAS = {
    "DepthSmoother": Idea(
        v3d.DepthSmoother(3, 0.8, 0.03),
        partial(v3d.smooth_depth, kernel_size=3, sigma=0.8, edge=0.03),
        image,
        {},
        ("depth",),
    ),
    "BackProjector": Idea(
        v3d.BackProjector(CAMERA), partial(v3d.back_project, rays=CAMERA.rays), image, {}, ("depth",)
    ),
    "VoxelPool": Idea(v3d.VoxelPool(0.3), partial(v3d.voxel_pool, size=0.3), cloud, CLOUD, ("points",)),
    "DBSCAN": Idea(v3d.DBSCAN(0.15, 3), partial(v3d.dbscan, eps=0.15, min_samples=3), cloud, CLOUD),
    "LargestClusters": Idea(
        v3d.LargestClusters(2), partial(v3d.largest_clusters, min_points=2), clustered, {"labels": "valid"}
    ),
    "HoughVoting": Idea(
        v3d.HoughVoting(0.2, 2), partial(v3d.hough_vote, distance_threshold=0.2, vote_threshold=2), centroids, CENTROIDS
    ),
    "soft HoughVoting": Idea(
        v3d.HoughVoting(0.2, 2, temperature=0.1),
        partial(v3d.hough_vote, distance_threshold=0.2, vote_threshold=2, temperature=0.1),
        centroids,
        CENTROIDS,
        ("previous", "current"),
    ),
    "ChamferDistance": Idea(v3d.ChamferDistance(), v3d.chamfer_distance, pair, PAIR, ("p", "q")),
    "IntraObjectMotion": Idea(
        v3d.IntraObjectMotion(0.2),
        partial(v3d.intra_object_motion, distance_threshold=0.2),
        then_and_now,
        TWICE,
        ("then", "now", "T_now_then"),
    ),
}
each = pytest.mark.parametrize("idea", IDEAS.values(), ids=IDEAS)
each_padded = pytest.mark.parametrize(
    "idea", [i for i in IDEAS.values() if i.masks], ids=[n for n, i in IDEAS.items() if i.masks]
)
each_differentiable = pytest.mark.parametrize(
    "idea", [i for i in IDEAS.values() if i.differentiable], ids=[n for n, i in IDEAS.items() if i.differentiable]
)


def tensors(result: object) -> tuple[Tensor, ...]:
    return (result,) if isinstance(result, Tensor) else tuple(result)  # type: ignore[call-overload]


def assert_same(result: object, expected: object) -> None:
    """Bit for bit, where NaN equals itself."""
    for one, other in zip(tensors(result), tensors(expected), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def fill(inputs: Inputs, masks: dict[str, str], filler: float) -> Inputs:
    """The same with something else where nothing is."""
    filled = copy.deepcopy(inputs)
    for name, mask in masks.items():
        filled[name][~inputs[mask]] = filler if inputs[name].is_floating_point() else 2**40
    return filled


# ---------------------------------------------------------------- all of them


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("batch", "count"), list(product((0, 1, 3, 100), (0, 1, 100))))
@each
def test_any_size_and_type(idea: Idea, batch: int, count: int, dtype: torch.dtype) -> None:
    inputs = idea.inputs(batch, count, dtype)
    before = copy.deepcopy(inputs)
    result = idea.module(**inputs)
    for tensor in tensors(result):
        assert tensor.shape[0] == batch
        assert tensor.dtype in (dtype, torch.int64, torch.bool)
    assert any(tensor.dtype == dtype for tensor in tensors(result)) or not idea.differentiable
    assert_same(idea.function(**inputs), result)
    assert_same(tuple(inputs.values()), tuple(before.values()))  # what came in is left as it was


@pytest.mark.parametrize("filler", [torch.nan, torch.inf, -torch.inf, 1e30, 0.0])
@each_padded
def test_content_of_padding_never_matters(idea: Idea, filler: float) -> None:
    inputs = idea.inputs(4, 30, torch.float64)
    assert_same(idea.module(**fill(inputs, idea.masks, filler)), idea.module(**inputs))


@each_padded
def test_length_of_padding_never_matters(idea: Idea) -> None:
    inputs = idea.inputs(4, 30, torch.float64)
    longer = dict(inputs)
    for name, mask in idea.masks.items():
        padding = torch.full_like(inputs[name][:, :7], torch.nan if inputs[name].is_floating_point() else 5)
        longer[name] = torch.cat([inputs[name], padding], dim=1)
        longer[mask] = torch.cat([inputs[mask], torch.zeros(4, 7, dtype=torch.bool)], dim=1)
    for one, other in zip(tensors(idea.module(**longer)), tensors(idea.module(**inputs)), strict=True):
        torch.testing.assert_close(one[tuple(map(slice, other.shape))], other, equal_nan=True)


@pytest.mark.parametrize("missing", [torch.nan, torch.inf, -1.0, 1e30])
def test_depth_that_is_no_measurement_never_matters(missing: float) -> None:
    depth = image(2, 0, torch.float64)["depth"]
    smooth = v3d.DepthSmoother()
    expected = smooth(depth)
    assert_same(smooth(torch.where(depth > 0, depth, missing)), expected)
    wider = torch.nn.functional.pad(depth, (3, 2, 1, 4), value=missing)
    assert_same(smooth(wider)[..., 1:-4, 3:-2], expected)


@each
def test_rows_of_a_batch_are_independent(idea: Idea) -> None:
    inputs = idea.inputs(3, 30, torch.float64)
    result = tensors(idea.module(**inputs))
    for b in range(3):
        alone = tensors(idea.module(**{name: tensor[b : b + 1] for name, tensor in inputs.items()}))
        for one, other in zip(alone, result, strict=True):
            row = other[b : b + 1]
            torch.testing.assert_close(one, row[tuple(map(slice, one.shape))], equal_nan=True)


@each
def test_runs_repeat_on_any_number_of_threads(idea: Idea) -> None:
    inputs = idea.inputs(6, 200, torch.float32)
    result = idea.module(**inputs)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert_same(idea.module(**inputs), result)
    finally:
        torch.set_num_threads(threads)


@each
def test_is_a_module_that_can_be_copied_and_stored(idea: Idea) -> None:
    assert isinstance(idea.module, torch.nn.Module)
    inputs = idea.inputs(2, 20, torch.float32)
    expected = idea.module(**inputs)
    twin = pickle.loads(pickle.dumps(idea.module))  # noqa: S301
    assert_same(twin(**inputs), expected)
    twin = copy.deepcopy(idea.module).eval()
    twin.load_state_dict(idea.module.state_dict())
    assert_same(twin(**inputs), expected)
    assert not list(idea.module.parameters())  # settings, nothing learnt, unless a parameter is given for one


# ---------------------------------------------------------------- gradients


def with_gradients(idea: Idea, inputs: Inputs) -> Callable[..., tuple[Tensor, ...]]:
    """The module as a function of its differentiable arguments, to those results that have a gradient."""

    def function(*arguments: Tensor) -> tuple[Tensor, ...]:
        result = idea.module(**(inputs | dict(zip(idea.differentiable, arguments, strict=True))))
        return tuple(tensor for tensor in tensors(result) if tensor.requires_grad)

    return function


@each_differentiable
def test_gradcheck(idea: Idea) -> None:
    inputs = idea.inputs(1, 6, torch.float64)
    arguments = [inputs[name].requires_grad_() for name in idea.differentiable]
    if idea.inputs is image:
        # A depth of 0 is a kink: of what is measured only.
        arguments = [inputs["depth"].detach().clamp(min=1).requires_grad_()]
    assert torch.autograd.gradcheck(with_gradients(idea, inputs), arguments)


@each_differentiable
def test_gradients_end_at_the_padding(idea: Idea) -> None:
    inputs = fill(idea.inputs(4, 20, torch.float64), idea.masks, torch.nan)
    arguments = [inputs[name].requires_grad_() for name in idea.differentiable]
    results = with_gradients(idea, inputs)(*arguments)
    torch.stack([tensor.nan_to_num().sum() for tensor in results]).sum().backward()
    for name, argument in zip(idea.differentiable, arguments, strict=True):
        assert argument.grad is not None and argument.grad.isfinite().all() and argument.grad.any()
        if name in idea.masks:
            assert not argument.grad[~inputs[idea.masks[name]]].any()


def test_smoothing_has_no_gradient_where_nothing_is_measured() -> None:
    depth = image(2, 0, torch.float64)["depth"].requires_grad_()
    v3d.smooth_depth(depth).sum().backward()
    assert depth.grad is not None and torch.equal(depth.grad != 0, depth > 0)


def test_thresholds_of_the_soft_vote_can_be_learnt() -> None:
    inputs = centroids(2, 6, torch.float64)
    settings = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (0.2, 0.1)]

    def votes(distance_threshold: Tensor, temperature: Tensor) -> Tensor:
        return v3d.hough_vote(
            **inputs, distance_threshold=distance_threshold, vote_threshold=2, temperature=temperature
        )[0]

    assert torch.autograd.gradcheck(votes, settings)
    module = v3d.HoughVoting(torch.nn.Parameter(torch.tensor(0.2)), 2, torch.nn.Parameter(torch.tensor(0.1)))
    assert dict(module.named_parameters()).keys() == {"distance_threshold", "temperature"}


def test_gradients_flow_from_pixels_to_votes() -> None:
    """Depth at two times, smoothed, back-projected, pooled; clouds compared, centroids voting."""
    depth = torch.stack([image(1, 0, torch.float64)["depth"][0], image(2, 0, torch.float64)["depth"][1]])
    depth.requires_grad_()
    points = v3d.BackProjector(CAMERA)(v3d.DepthSmoother()(depth)).flatten(1, 2)
    column = torch.arange(CAMERA.width).repeat(CAMERA.height)
    masks = torch.stack([column // 4 == k for k in range(3)])  # three objects side by side
    measured = (depth[:, 0].detach() > 0).flatten(1)
    pooled = v3d.VoxelPool(0.05)(points.repeat_interleave(3, dim=0), (measured[:, None] & masks).flatten(0, 1))
    clouds, valid = pooled.means.unflatten(0, (2, 3)), pooled.valid.unflatten(0, (2, 3))
    centroid = clouds.sum(dim=2) / valid.sum(dim=2, keepdim=True)
    vote = v3d.HoughVoting(0.02, 1, temperature=0.02)
    ballots = vote(centroid[0], centroid[1], torch.ones(3, dtype=torch.bool))
    change = v3d.ChamferDistance()(clouds[0], clouds[1], valid[0], valid[1])
    for loss in (ballots.votes.sum(), change.sum()):
        (gradient,) = torch.autograd.grad(loss, depth, retain_graph=True)
        assert gradient.isfinite().all() and gradient.any()
        assert not gradient[depth <= 0].any()


# ---------------------------------------------------------------- ids


def boxes(count: int, shift: float, dtype: torch.dtype) -> tuple[v3d.Instances, InstanceClouds, Tensor]:
    """A grid of things 0.3 m apart before a wall, moved to the right; instances, their clouds, depth."""
    camera = TRACKED
    place = torch.stack([torch.arange(count) % 10, torch.arange(count) // 10], dim=1).to(dtype) * 0.3 - 1.4
    corner = torch.cartesian_prod(*[torch.tensor([-0.08, 0.0, 0.08], dtype=dtype)] * 2)
    xy = place[:, None] + corner + torch.tensor([shift, 0.0], dtype=dtype)
    points = torch.cat([xy, torch.full((count, 9, 1), 2.0, dtype=dtype)], dim=2)
    uv = camera.project(points)
    low, high = uv.amin(dim=1), uv.amax(dim=1)
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    inside = (u >= low[:, :1, None]) & (u <= high[:, :1, None]) & (v >= low[:, 1:, None]) & (v <= high[:, 1:, None])
    depth = torch.where(inside.any(dim=0), 2.0, 4.0).to(dtype)[None]
    instances = v3d.Instances(inside, torch.zeros(count, dtype=torch.int64), torch.ones(count), torch.zeros(count, 4))
    clouds = InstanceClouds(points, torch.ones(count, 9, dtype=torch.bool), points.mean(dim=1), inside)
    return instances, clouds, depth


TRACKED = v3d.PinholeCamera(fx=100.0, fy=100.0, cx=79.5, cy=79.5, width=160, height=160)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("batch", "count"), list(product((0, 1, 3), (0, 1, 100))))
def test_matching_in_batches(batch: int, count: int, dtype: torch.dtype) -> None:
    """Objects that have moved a little and been shuffled; some of either side are not there."""
    seen = 10 * some(batch, count, 3, dtype=dtype)
    order = some(batch, count, dtype=torch.float64, seed=6).argsort(dim=1)
    predicted = seen.gather(1, order[..., None].expand_as(seen)) + 0.001
    tracked, present = ragged(batch, count), ragged(batch, count, 7)
    predicted[~tracked], seen[~present] = torch.inf, 5.0
    overlap = torch.zeros(batch, count, count, dtype=dtype)
    alike = torch.ones(batch, count, count, dtype=torch.bool)
    gate = torch.full((batch, count), 0.1, dtype=dtype)
    matched = v3d.match_instances(predicted, seen, overlap, alike, gate, 0.5, tracked, present)
    expected = order.argsort(dim=1)  # where each instance has gone
    known = present & tracked.gather(1, expected)
    assert matched.dtype == torch.int64 and torch.equal(matched, torch.where(known, expected, -1))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [0, 1, 100])
def test_tracker_alone(count: int, dtype: torch.dtype) -> None:
    track = v3d.InstanceTracker(v3d.Config().objects.tracker, TRACKED, voxel_size=0.05)
    here = torch.eye(4, dtype=torch.float64)
    for frame in range(3):
        instances, clouds, depth = boxes(count, 0.05 * frame, dtype)
        tracks = track(frame / 30, instances, clouds, depth, here)
        assert [t.id for t in tracks] == list(range(1, count + 1))  # nobody takes his neighbour's number
    for t, centroid in zip(tracks, clouds.centroid, strict=True):
        assert t.newest.cloud.dtype == dtype
        torch.testing.assert_close(t.newest.centroid, centroid.double())
    nobody, nothing, _ = boxes(0, 0.0, dtype)
    missed = track(0.1, nobody, nothing, boxes(count, 0.15, dtype)[2], here)
    assert len(missed) == count and all(t.missed and t.mask.any() for t in missed)
