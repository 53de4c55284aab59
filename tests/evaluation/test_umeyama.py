"""Least-squares alignment against evo, known transforms and SciPy; weights, padding, gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from evo.core.geometry import umeyama_alignment
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.evaluation.umeyama import nearest_rotation, umeyama
from v3d_torch.geometry.se3 import se3_exp


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("with_scale", [False, True])
def test_transform_equals_evo(with_scale: bool) -> None:
    p, q = normal(30, 3), normal(30, 3, seed=1)
    R, t, scale = umeyama_alignment(p.numpy().T, q.numpy().T, with_scale)
    found = umeyama(p, q, with_scale=with_scale)
    np.testing.assert_allclose(found[:3, :3], (scale if with_scale else 1) * R, atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], t, atol=1e-12)


def test_convention_transform_maps_p_to_q() -> None:
    T_qp = se3_exp(normal(4, 6))
    T_qp[:, :3, :3] *= 1.7
    p = normal(4, 10, 3, seed=1)
    q = p @ T_qp[:, :3, :3].mT + T_qp[:, None, :3, 3]
    torch.testing.assert_close(umeyama(p, q, with_scale=True), T_qp)
    single = umeyama(p.float(), q.float(), with_scale=True)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), T_qp, rtol=0, atol=1e-5)


@settings(max_examples=30)
@given(st.lists(st.integers(0, 3), min_size=12, max_size=12).filter(lambda counts: sum(map(bool, counts)) > 3))
def test_weights_count_pairs_and_padding_does_not(counts: list[int]) -> None:
    p, q = normal(12, 3), normal(12, 3, seed=1)
    weights = torch.tensor(counts)
    valid = weights > 0
    repeats = torch.arange(12).repeat_interleave(weights)
    expected = umeyama(p[repeats], q[repeats], with_scale=True)
    torch.testing.assert_close(umeyama(p, q, weights, with_scale=True), expected)
    padded = torch.where(valid[:, None], p, torch.nan)
    torch.testing.assert_close(umeyama(padded, q, weights, valid, with_scale=True), expected)


def test_without_points_the_transform_is_the_identity() -> None:
    eye, p = torch.eye(4, dtype=torch.float64), normal(2, 5, 3)
    assert torch.equal(umeyama(p[:, :0], p[:, :0]), eye.expand(2, 4, 4))
    assert torch.equal(umeyama(p, p, valid=torch.zeros(2, 5, dtype=torch.bool)), eye.expand(2, 4, 4))


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_scale_of_points_at_one_place_is_one(count: int, weighted: bool) -> None:
    p = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).repeat(count, 1).requires_grad_()
    weights = torch.ones(count, dtype=torch.float64) if weighted else None
    T = umeyama(p, p.detach() + 1.0, weights, with_scale=True)
    torch.testing.assert_close(torch.linalg.det(T), torch.tensor(1.0, dtype=torch.float64))
    T.sum().backward()
    assert p.grad is not None and p.grad.isfinite().all()


def test_scale_of_a_single_pair_is_one() -> None:
    """The mean of one pair, and of several at one place, differs from them by rounding errors."""
    p, q = 100 * normal(1000, 7, 3), normal(1000, 7, 3, seed=1)
    weights = torch.rand(1000, 7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    one = torch.tensor([0, 0, 1, 0, 0, 0, 0])
    for points, each in ((p, one * weights), (p[:, :1].expand(-1, 7, -1), weights)):
        T = umeyama(points, q, each, with_scale=True)
        torch.testing.assert_close(torch.linalg.det(T), torch.ones(1000, dtype=torch.float64))


def test_scale_of_points_near_each_other_and_far_from_the_origin() -> None:
    p = 1e-6 * normal(7, 3) + torch.tensor([100.0, -20.0, 3.0])
    T = umeyama(p, 2 * p, with_scale=True)
    torch.testing.assert_close(T[:3, :3], 2 * torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-6)


@pytest.mark.parametrize("bad", [-0.1, torch.nan])
def test_negative_weights_are_rejected(bad: float) -> None:
    """The transform of points with negative weights has no smallest squared error."""
    p, q, weights = normal(7, 3), normal(7, 3, seed=1), torch.ones(7)
    weights[3] = bad
    with pytest.raises(InputError, match="weights has a value that is negative or NaN"):
        umeyama(p, q, weights)
    valid = torch.arange(7) != 3
    torch.testing.assert_close(umeyama(p, q, weights, valid), umeyama(p[valid], q[valid]))


@pytest.mark.parametrize("name", ["weights", "valid"])
@pytest.mark.parametrize("shape", [(7, 1), (6,), (1,)])
def test_weights_of_another_shape_are_rejected(name: str, shape: tuple[int, ...]) -> None:
    dtype = torch.bool if name == "valid" else torch.float64
    with pytest.raises(ShapeError):
        umeyama(normal(7, 3), normal(7, 3, seed=1), **{name: torch.ones(shape, dtype=dtype)})


def test_fully_padded_row_with_scale_is_the_identity() -> None:
    p, valid = normal(2, 4, 3), torch.tensor([[True] * 4, [False] * 4])
    T = umeyama(p, 2 * p, valid=valid, with_scale=True)
    torch.testing.assert_close(T, torch.diag_embed(torch.tensor([[2.0, 2, 2, 1], [1, 1, 1, 1]], dtype=T.dtype)))


def test_nearest_rotation_equals_scipy() -> None:
    M = normal(20, 3, 3)
    for one, other in zip(nearest_rotation(M), M, strict=True):
        # The rotation that maps the columns of the identity best to those of M.
        expected = Rotation.align_vectors(other.T.numpy(), np.eye(3))[0].as_matrix()
        np.testing.assert_allclose(one, expected, atol=1e-9)
        assert torch.linalg.det(one) == pytest.approx(1)


@pytest.mark.parametrize("shape", ["room", "plane", "mirrored"])
@pytest.mark.parametrize("with_scale", [False, True])
def test_gradients_equal_finite_differences(shape: str, with_scale: bool) -> None:
    """In a plane, the gradients of the singular vectors are not finite."""
    p, q = normal(7, 3), normal(7, 3, seed=1)
    if shape == "plane":
        p[:, 2] = q[:, 2] = 0
    if shape == "mirrored":
        q = p * torch.tensor([1.0, 1.0, -1.0]) + 0.01 * q
    weights = 0.5 + torch.rand(7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    arguments = [each.requires_grad_() for each in (p, q, weights)]
    assert torch.autograd.gradcheck(lambda *args: umeyama(*args, with_scale=with_scale), arguments)


def test_gradients_of_points_on_a_line_or_at_one_place_are_finite() -> None:
    for scale in (torch.tensor([1.0, 0.0, 0.0]), torch.zeros(3)):
        p = (normal(6, 3) * scale).requires_grad_()
        umeyama(p, p.detach() + 1.0).sum().backward()
        assert p.grad is not None and p.grad.isfinite().all()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_points_that_are_not_finite_do_not_affect_the_others_of_a_batch(bad: float) -> None:
    p, q = normal(3, 7, 3), normal(3, 7, 3, seed=1)
    p[1, 2, 0] = bad
    p.requires_grad_()
    found = umeyama(p, q)
    assert found[1, :3].isnan().all()
    torch.testing.assert_close(found[::2], torch.stack([umeyama(p[0], q[0]), umeyama(p[2], q[2])]))
    found[::2].sum().backward()
    assert p.grad is not None and p.grad[::2].isfinite().all() and p.grad[::2].any()
    torch.testing.assert_close(umeyama(p.detach(), q), found.detach(), equal_nan=True)
