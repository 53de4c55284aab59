"""Pose-graph optimisation against GTSAM, autograd, and graphs with known solutions; gradients, PyPose's types."""

from __future__ import annotations

import math

import pypose as pp
import pytest
import torch
from helpers import camera_inputs
from helpers.gradients import check_gradients
from helpers.random_numbers import RandomNumbers
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from torch import Tensor

from v3d_torch.backend.pose_graph import edge_errors, optimise_pose_graph
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.kernels import compiler

SIGMA = torch.tensor([0.01] * 3 + [0.005] * 3, dtype=torch.float64)


class Graph:
    """Poses on two laps of a circle, noisy relative poses between them, and initial poses that drift."""

    def __init__(self, poses: int, loops: int, noise: float = 1.0, seed: int = 0) -> None:
        random = RandomNumbers(seed)
        angle = torch.linspace(0, 4 * math.pi, poses, dtype=torch.float64)
        o = torch.zeros_like(angle)
        place = torch.stack([2 * angle.cos(), 2 * angle.sin(), 0.2 * (3 * angle).sin(), o, o, o], dim=1)
        turn = torch.stack([o, o, o, o, o, angle], dim=1)
        self.T_wc = se3_exp(place) @ se3_exp(turn) @ se3_exp(0.1 * random.normal(poses, 6))
        chain = torch.stack([torch.arange(poses - 1), torch.arange(1, poses)], dim=1)
        ends = torch.randint(0, poses, (loops, 2), generator=random.generator)
        self.edges = torch.cat([chain, ends[ends[:, 0] != ends[:, 1]]])
        i, j = self.edges.unbind(dim=1)
        error = noise * SIGMA * random.normal(len(i), 6)
        self.T_ij = invert(self.T_wc[i]) @ self.T_wc[j] @ se3_exp(error)
        self.information = torch.diag(SIGMA**-2).expand(len(i), 6, 6)
        drifting = [self.T_wc[0]]
        for T in self.T_ij[: poses - 1]:
            drifting.append(drifting[-1] @ T)
        self.start = torch.stack(drifting)


def optimise_with_gtsam(graph: Graph, information: Tensor, kernel: float | None = None) -> tuple[Tensor, float]:
    """Optimal poses and cost according to GTSAM, with Huber's loss if a threshold is given."""
    gtsam = pytest.importorskip("gtsam")  # not on Windows
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, T in enumerate(graph.start):
        start.insert(k, gtsam.Pose3(T.numpy()))
    factors.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3(graph.start[0].numpy())))
    rotation_first = torch.tensor([3, 4, 5, 0, 1, 2])
    for (i, j), T, omega in zip(graph.edges.tolist(), graph.T_ij, information, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(omega[rotation_first][:, rotation_first].numpy())
        if kernel is not None:
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(kernel), noise)
        factors.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(T.numpy()), noise))
    settings_ = gtsam.LevenbergMarquardtParams()
    settings_.setRelativeErrorTol(1e-10)
    best = gtsam.LevenbergMarquardtOptimizer(factors, start, settings_).optimize()
    poses = torch.stack([torch.from_numpy(best.atPose3(k).matrix()) for k in range(graph.start.shape[0])])
    return poses, 2 * factors.error(best)


@pytest.mark.parametrize(("poses", "loops"), [(30, 3), (300, 40), (1000, 100)])
def test_optimum_equals_that_of_gtsam(poses: int, loops: int) -> None:
    graph = Graph(poses, loops)
    result = optimise_pose_graph(graph.start, graph.edges, graph.T_ij, graph.information)
    expected, cost = optimise_with_gtsam(graph, graph.information)
    assert result.converged
    assert result.cost_after == pytest.approx(cost, rel=1e-6)
    assert (result.T_wc - expected).abs().max() < 1e-5
    drift = (graph.start - graph.T_wc)[:, :3, 3].norm(dim=1).max()
    assert (result.T_wc - graph.T_wc)[:, :3, 3].norm(dim=1).max() < drift


def test_robust_optimum_equals_that_of_gtsam_and_resists_a_wrong_loop() -> None:
    graph = Graph(60, 15)
    graph.T_ij[-1] = graph.T_ij[-1] @ se3_exp(torch.tensor([0.5, 0.3, 0.0, 0.0, 0.4, 0.0], dtype=torch.float64))
    result = optimise_pose_graph(graph.start, graph.edges, graph.T_ij, graph.information, robust=3.0)
    expected, cost = optimise_with_gtsam(graph, graph.information, kernel=3.0)
    assert result.cost_after == pytest.approx(cost, rel=1e-4)
    assert (result.T_wc - expected).abs().max() < 1e-3
    plain = optimise_pose_graph(graph.start, graph.edges, graph.T_ij, graph.information)
    clean = optimise_pose_graph(graph.start, graph.edges[:-1], graph.T_ij[:-1], graph.information[:-1])
    error, plain_error = ((r.T_wc - clean.T_wc)[:, :3, 3].norm(dim=1).mean() for r in (result, plain))
    assert error < 0.25 * plain_error


def test_convention_information_orders_translation_first() -> None:
    graph = Graph(20, 4)
    information = torch.diag(torch.tensor([1e6, 1e2, 1e4, 1e3, 1e5, 1e4], dtype=torch.float64))
    information = information.expand(graph.edges.shape[0], 6, 6)
    result = optimise_pose_graph(graph.start, graph.edges, graph.T_ij, information)
    expected, cost = optimise_with_gtsam(graph, information)
    assert result.cost_after == pytest.approx(cost, rel=1e-6)
    assert (result.T_wc - expected).abs().max() < 1e-5


def test_jacobians_equal_autograd() -> None:
    graph = Graph(12, 8, noise=20.0)
    i, j = graph.edges.unbind(dim=1)
    T_wi, T_wj, T_ji = graph.T_wc[i], graph.T_wc[j], invert(graph.T_ij)
    count = len(i)

    def errors(xi: Tensor, xj: Tensor) -> Tensor:
        return se3_log(T_ji @ invert(T_wi @ se3_exp(xi)) @ T_wj @ se3_exp(xj))

    zeros = torch.zeros(count, 6, dtype=torch.float64)
    expected_i, expected_j = torch.autograd.functional.jacobian(errors, (zeros, zeros))
    each = torch.arange(count)
    error, J_i, J_j = edge_errors(T_wi, T_wj, T_ji)
    torch.testing.assert_close(error, errors(zeros, zeros), rtol=0, atol=1e-10)
    torch.testing.assert_close(J_i, expected_i[each, :, each], rtol=0, atol=1e-9)
    torch.testing.assert_close(J_j, expected_j[each, :, each], rtol=0, atol=1e-9)


def test_convention_T_ij_is_the_pose_of_j_in_i() -> None:
    step = se3_exp(torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.5], dtype=torch.float64))
    identity = torch.eye(4, dtype=torch.float64)
    result = optimise_pose_graph(torch.stack([identity, identity]), torch.tensor([[0, 1]]), step[None])
    torch.testing.assert_close(result.T_wc[1], step, rtol=0, atol=1e-9)
    assert torch.equal(result.T_wc[0], identity)


@st.composite
def consistent_graphs(draw: st.DrawFn) -> tuple[Tensor, Tensor]:
    """Poses and the edges of a connected graph, in random order and direction."""
    count = draw(st.integers(2, 12))
    numbers = draw(st.lists(st.floats(-1.5, 1.5), min_size=6 * count, max_size=6 * count))
    T_wc = se3_exp(torch.tensor(numbers, dtype=torch.float64).reshape(count, 6))
    tree = [(draw(st.integers(0, k - 1)), k) for k in range(1, count)]
    pairs = st.tuples(st.integers(0, count - 1), st.integers(0, count - 1)).filter(lambda pair: pair[0] != pair[1])
    edges = draw(st.permutations(tree + draw(st.lists(pairs, max_size=10))))
    flipped = [(j, i) if draw(st.booleans()) else (i, j) for i, j in edges]
    return T_wc, torch.tensor(flipped)


@settings(max_examples=25)
@given(consistent_graphs(), st.integers(0, 100))
def test_consistent_measurements_are_fitted_exactly(graph: tuple[Tensor, Tensor], seed: int) -> None:
    T_wc, edges = graph
    T_ij = invert(T_wc[edges[:, 0]]) @ T_wc[edges[:, 1]]
    generator = torch.Generator().manual_seed(seed)
    perturbation = 0.1 * torch.randn(T_wc.shape[0], 6, generator=generator, dtype=torch.float64)
    perturbation[0] = 0.0
    result = optimise_pose_graph(T_wc @ se3_exp(perturbation), edges, T_ij)
    torch.testing.assert_close(result.T_wc, T_wc, rtol=0, atol=1e-4)
    assert result.cost_after <= result.cost_before


@settings(max_examples=10)
@given(st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
def test_solution_moves_with_the_world_frame(numbers: list[float]) -> None:
    graph = Graph(20, 5)
    T_vw = se3_exp(torch.tensor(numbers, dtype=torch.float64))
    original = optimise_pose_graph(graph.start, graph.edges, graph.T_ij, graph.information)
    moved = optimise_pose_graph(T_vw @ graph.start, graph.edges, graph.T_ij, graph.information)
    torch.testing.assert_close(moved.T_wc, T_vw @ original.T_wc, rtol=0, atol=1e-6)


def test_graph_with_exact_rotations_converges() -> None:
    """Rotation errors are of the size of rounding, at which PyPose's Jacobian has few correct digits."""
    count = 50
    T_wc = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T_wc[:, 0, 3] = torch.arange(count) * 0.1
    edges = torch.tensor([(k, k + d) for k in range(count) for d in (1, 7) if k + d < count])
    T_ij = invert(T_wc[edges[:, 0]]) @ T_wc[edges[:, 1]]
    start = T_wc.clone()
    start[1:, 1, 3] += 0.3
    result = optimise_pose_graph(start, edges, T_ij)
    assert result.converged
    torch.testing.assert_close(result.T_wc, T_wc, rtol=0, atol=1e-4)


def test_fixed_poses_are_bit_identical() -> None:
    graph = Graph(20, 5)
    fixed = torch.zeros(20, dtype=torch.bool)
    fixed[[3, 11]] = True
    result = optimise_pose_graph(graph.start, graph.edges, graph.T_ij, fixed=fixed)
    assert torch.equal(result.T_wc[fixed], graph.start[fixed])
    assert not torch.equal(result.T_wc[0], graph.start[0])


def test_poses_without_edges_do_not_move() -> None:
    graph = Graph(20, 5)
    isolated = se3_exp(torch.tensor([[9.0, 0.0, 0.0, 0.0, 0.0, 1.0]], dtype=torch.float64))
    result = optimise_pose_graph(torch.cat([graph.start, isolated]), graph.edges, graph.T_ij)
    torch.testing.assert_close(result.T_wc[-1:], isolated, rtol=0, atol=1e-12)


def test_component_without_a_fixed_pose_is_solved() -> None:
    graph = Graph(20, 0)
    is_kept = (graph.edges != 10).all(dim=1)
    edges, T_ij = graph.edges[is_kept], graph.T_ij[is_kept]
    start = graph.start @ se3_exp(0.05 * torch.sin(torch.arange(120.0, dtype=torch.float64)).reshape(20, 6))
    result = optimise_pose_graph(start, edges, T_ij)
    assert result.cost_after < 1e-6
    assert torch.isfinite(result.T_wc).all()


def test_optimisation_is_deterministic() -> None:
    graph = Graph(50, 10)
    first, second = (optimise_pose_graph(graph.start, graph.edges, graph.T_ij).T_wc for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize(
    ("poses", "loops", "fixed"), [(40, 60, [0]), (40, 2, [0, 7, 20]), (3, 0, [0, 1, 2]), (9, 30, [])]
)
def test_kernel_equals_its_twin(poses: int, loops: int, fixed: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Graphs with many loops and with few, repeated edges, no free pose, no fixed pose."""
    graph, is_fixed = Graph(poses, loops), torch.isin(torch.arange(poses), torch.tensor(fixed, dtype=torch.int64))
    given = graph.start, graph.edges, graph.T_ij, graph.information, is_fixed
    compiled = optimise_pose_graph(*given, robust=2.0)
    monkeypatch.setattr(compiler, "ENABLED", False)
    twin = optimise_pose_graph(*given, robust=2.0)
    assert compiled.iterations == twin.iterations and compiled.converged == twin.converged
    torch.testing.assert_close(compiled.cost_before, twin.cost_before, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(compiled.cost_after, twin.cost_after, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(compiled.T_wc, twin.T_wc, rtol=0, atol=1e-5 if fixed == [] else 1e-8)


# ---------------------------------------------------------------- batches, padding


@settings(max_examples=15)
@given(st.lists(st.booleans(), min_size=15, max_size=15))
def test_padding_between_edges_has_no_effect(present: list[bool]) -> None:
    inputs, valid = camera_inputs.graph(1, 15, torch.float64), torch.tensor(present)
    per_edge = [name for name, each in inputs.items() if each.shape[1:2] == (15,)]
    alone = {name: each[:, valid] if name in per_edge else each for name, each in inputs.items()}
    padded = dict(inputs)
    for name in per_edge:
        padded[name] = inputs[name].clone()
        padded[name][:, ~valid] = torch.nan if inputs[name].is_floating_point() else 1000
    found = optimise_pose_graph(**padded | {"valid": valid[None]})
    expected = optimise_pose_graph(**alone | {"valid": None})
    torch.testing.assert_close(found.T_wc, expected.T_wc, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.cost_after, expected.cost_after, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("index", [-1, 6])
def test_index_out_of_range_is_rejected(index: int) -> None:
    graph = Graph(poses=6, loops=2)
    edges = graph.edges.clone()
    edges[3, 1] = index
    with pytest.raises(InputError, match=f"edges contains the index {index}; .* at least 0 and below 6"):
        optimise_pose_graph(graph.start, edges, graph.T_ij)
    with pytest.raises(InputError, match=r"edges has the type torch\.int32; give .* torch\.int64"):
        optimise_pose_graph(graph.start, graph.edges.to(torch.int32), graph.T_ij)


def test_edge_from_a_pose_to_itself_is_rejected() -> None:
    graph = Graph(poses=6, loops=2)
    edges, valid = graph.edges.clone(), torch.arange(len(graph.edges)) != 3
    edges[3] = 2
    with pytest.raises(InputError, match=r"^edges joins pose 2 to itself; give edges between two different poses$"):
        optimise_pose_graph(graph.start, edges, graph.T_ij)
    optimise_pose_graph(graph.start, edges, graph.T_ij, valid=valid)  # padding can be any edge


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("information", (6, 6)),  # as many rows as edges
        ("information", (1, 6, 6)),
        ("information", (6, 6, 5)),
        ("fixed", (1,)),
        ("fixed", (6,)),
        ("weights", (1,)),
        ("weights", (6, 1)),
        ("valid", (1,)),
        ("valid", ()),
    ],
)
def test_arguments_of_another_shape_are_rejected(name: str, shape: tuple[int, ...]) -> None:
    """One matrix, weight or mask was used for all edges or poses."""
    graph = Graph(poses=7, loops=0)
    assert len(graph.edges) == 6
    given = torch.ones(shape, dtype=torch.bool if name in ("fixed", "valid") else torch.float64)
    with pytest.raises(ShapeError):
        optimise_pose_graph(graph.start, graph.edges, graph.T_ij, **{name: given})


# ---------------------------------------------------------------- gradients

CONVERGED = {"iterations": 200, "tolerance": 1e-15, "robust": 1.2}


def noisy_graph(batch: int) -> dict[str, Tensor]:
    """Graphs with errors on both sides of the threshold of Huber's loss, but not at it; one edge is padding."""
    inputs = camera_inputs.graph(batch, 11, torch.float64)
    inputs["T_ij"][:, ::4] = inputs["T_ij"][:, ::4] @ se3_exp(torch.full((6,), 0.1, dtype=torch.float64))
    return inputs | {"valid": torch.arange(11).expand(batch, 11) != 7}


def test_gradients_equal_finite_differences() -> None:
    """With respect to measured poses, information, weights, and the fixed pose."""
    inputs = noisy_graph(2)

    def optimised(error: Tensor, scale: Tensor, weights: Tensor, xi: Tensor) -> Tensor:
        given = {
            "T_wc": torch.cat([inputs["T_wc"][:, :1] @ se3_exp(xi), inputs["T_wc"][:, 1:]], dim=1),
            "T_ij": inputs["T_ij"] @ se3_exp(error),
            "information": inputs["information"] * scale.exp()[..., None, None],
            "weights": weights,
        }
        found = optimise_pose_graph(**inputs | given, **CONVERGED)
        return torch.cat([found.T_wc.flatten(1), 0.01 * found.cost_after[:, None]], dim=1)

    error, xi = torch.zeros(2, 11, 6, dtype=torch.float64), torch.zeros(2, 1, 6, dtype=torch.float64)
    scale = torch.zeros(2, 11, dtype=torch.float64)
    assert check_gradients(optimised, error, scale, inputs["weights"], xi, step=1e-4)


def test_gradients_at_exact_measurements_are_finite() -> None:
    graph = Graph(10, 5, noise=0.0)
    T_ij = graph.T_ij.clone().requires_grad_()
    found = optimise_pose_graph(graph.T_wc, graph.edges, T_ij, graph.information)
    (gradient,) = torch.autograd.grad(found.T_wc.square().sum(), T_ij)
    assert gradient.isfinite().all() and gradient.any()


def test_pypose_types_give_the_same_result_and_gradient() -> None:
    inputs = noisy_graph(2)
    T_wc, T_ij = (pp.mat2SE3(inputs.pop(name), check=False) for name in ("T_wc", "T_ij"))
    by_pypose = pp.se3(torch.zeros(2, 11, 6, dtype=torch.float64)).requires_grad_()
    found = optimise_pose_graph(T_wc, T_ij=T_ij @ by_pypose.Exp(), **inputs, **CONVERGED)
    assert isinstance(found.T_wc, pp.LieTensor) and found.T_wc.ltype is pp.SE3_type
    assert torch.equal(found.T_wc[:, 0].tensor(), T_wc[:, 0].tensor())
    found.T_wc.Log().tensor().square().sum().backward()
    xi = torch.zeros(2, 11, 6, dtype=torch.float64, requires_grad=True)
    expected = optimise_pose_graph(T_wc.matrix(), T_ij=T_ij.matrix() @ se3_exp(xi), **inputs, **CONVERGED)
    torch.testing.assert_close(found.T_wc.matrix(), expected.T_wc, rtol=0, atol=1e-9)
    se3_log(expected.T_wc).square().sum().backward()
    torch.testing.assert_close(by_pypose.grad.as_subclass(Tensor), xi.grad, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("twin", ["torch", "compiled"])
def test_skew_part_of_the_information_changes_nothing(twin: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has no influence on the cost, but the step used it."""
    graph = Graph(12, 4)
    monkeypatch.setattr(compiler, "ENABLED", compiler.ENABLED and twin == "compiled")
    change = RandomNumbers(1).normal(len(graph.edges), 6, 6).round() * 2**10
    expected = optimise_pose_graph(graph.start, graph.edges, graph.T_ij, graph.information)
    found = optimise_pose_graph(graph.start, graph.edges, graph.T_ij, graph.information + change - change.mT)
    torch.testing.assert_close(found.T_wc, expected.T_wc, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.cost_after, expected.cost_after)


def test_negative_information_is_an_error() -> None:
    graph = Graph(5, 1)
    information = graph.information.clone()
    information[1, 3, 3] = -1
    with pytest.raises(InputError, match=r"^information has a negative value on a diagonal"):
        optimise_pose_graph(graph.start, graph.edges, graph.T_ij, information)
    present = torch.arange(len(graph.edges)) != 1
    optimise_pose_graph(graph.start, graph.edges, graph.T_ij, information, valid=present)
