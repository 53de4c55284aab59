"""SE(3) against PyPose, from the smallest rotation angles to half turns."""

from __future__ import annotations

import math

import pypose as pp
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from v3d_torch.geometry.se3 import (
    adjoint,
    are_rigid,
    interpolate,
    invert,
    left_jacobian_inverse,
    orthonormalise,
    se3_exp,
    se3_log,
)


def tangents(angle: float, count: int = 64) -> Tensor:
    """Tangent vectors with the given rotation angle."""
    generator = torch.Generator().manual_seed(1)
    xi = torch.randn(count, 6, generator=generator, dtype=torch.float64)
    xi[:, 3:] *= angle / xi[:, 3:].norm(dim=1, keepdim=True)
    return xi


ANGLES = [0.0, 1e-9, 9.9e-5, 1.1e-4, 0.1, 1.0, 3.0, math.pi - 1e-7]


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_equals_pypose(angle: float) -> None:
    xi = tangents(angle)
    # PyPose's exponential is accurate to only 1e-8 at tiny angles.
    torch.testing.assert_close(se3_exp(xi), pp.se3(xi).Exp().matrix(), rtol=0, atol=1e-8 if angle < 1e-3 else 1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_equals_pypose(angle: float) -> None:
    T = se3_exp(tangents(angle))
    torch.testing.assert_close(se3_log(T), pp.mat2SE3(T, check=False).Log().tensor(), rtol=0, atol=1e-13)


@pytest.mark.parametrize("angle", [*ANGLES, 9.9e-3, 1.01e-2])
def test_left_jacobian_inverse_is_the_derivative_of_the_logarithm(angle: float) -> None:
    xi = tangents(angle, 8)
    T = se3_exp(xi)

    def perturbed(epsilon: Tensor) -> Tensor:
        return se3_log(se3_exp(epsilon) @ T)

    expected = torch.autograd.functional.jacobian(perturbed, torch.zeros(8, 6, dtype=torch.float64))
    each = torch.arange(8)
    torch.testing.assert_close(
        left_jacobian_inverse(xi), expected[each, :, each], rtol=0, atol=1e-7 if angle > 3 else 1e-11
    )


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9e-3, 1.0])
def test_left_jacobian_inverse_has_gradients(angle: float) -> None:
    assert torch.autograd.gradcheck(left_jacobian_inverse, tangents(angle, 2).requires_grad_())


@pytest.mark.parametrize("angle", ANGLES)
def test_convention_adjoint_moves_a_perturbation_from_right_to_left(angle: float) -> None:
    T, xi = se3_exp(tangents(angle)), 0.3 * tangents(1.0).flip(0)
    left = (adjoint(T) @ xi[..., None])[..., 0]
    torch.testing.assert_close(se3_exp(left) @ T, T @ se3_exp(xi), rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(angle: float) -> None:
    xi = tangents(angle)
    torch.testing.assert_close(se3_log(se3_exp(xi)), xi, rtol=0, atol=1e-13)


def test_log_of_small_rotations_keeps_all_digits() -> None:
    xi = tangents(1e-9)
    torch.testing.assert_close(se3_log(se3_exp(xi))[:, 3:], xi[:, 3:], rtol=1e-12, atol=0)


def test_log_of_half_turns() -> None:
    xi = math.pi * torch.eye(6, dtype=torch.float64)[3:]
    torch.testing.assert_close(se3_log(se3_exp(xi)).abs(), xi, rtol=0, atol=1e-13)


@settings(max_examples=50)
@given(st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6))
def test_group_laws(numbers: list[float]) -> None:
    xi = torch.tensor(numbers, dtype=torch.float64)
    T = se3_exp(xi)
    identity = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(T @ invert(T), identity, rtol=0, atol=1e-13)
    torch.testing.assert_close(se3_exp(-xi), invert(T), rtol=0, atol=1e-13)
    torch.testing.assert_close(se3_exp(0.5 * xi) @ se3_exp(0.5 * xi), T, rtol=0, atol=1e-13)


def test_convention_tangent_vector_is_translation_then_rotation() -> None:
    T = se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    assert T[:3, 3].tolist() == [1.0, 2.0, 3.0]
    quarter = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2], dtype=torch.float64))
    x = quarter[:3, :3] @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(x, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_orthonormalise_returns_the_nearest_rotation() -> None:
    T = se3_exp(tangents(2.0))
    torch.testing.assert_close(orthonormalise(T), T, rtol=0, atol=1e-14)
    perturbed = T.clone()
    perturbed[:, :3, :3] += 1e-3 * torch.sin(torch.arange(64 * 9, dtype=torch.float64)).reshape(64, 3, 3)
    nearest = orthonormalise(perturbed)
    R = nearest[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(64, 3, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(nearest, T, rtol=0, atol=5e-3)
    # The nearest rotation R makes R^T M symmetric (polar decomposition).
    stretch = R.mT @ perturbed[:, :3, :3]
    torch.testing.assert_close(stretch, stretch.mT, rtol=0, atol=1e-14)


def test_orthonormalise_has_gradients() -> None:
    """The singular vectors of rotations, whose singular values are equal, have none."""
    T = se3_exp(tangents(2.0, 3))
    changed = T.clone()
    changed[:, :3, :3] += 0.1 * torch.sin(torch.arange(27, dtype=torch.float64)).reshape(3, 3, 3)
    mirrored = changed.clone()
    mirrored[:, :3, 0] *= -1
    for each in (T, changed, mirrored):
        assert torch.autograd.gradcheck(orthonormalise, each.requires_grad_())


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.int64])
def test_orthonormalise_in_another_dtype(dtype: torch.dtype) -> None:
    T = (se3_exp(tangents(2.0, 3)) if dtype.is_floating_point else torch.eye(4)).to(dtype)
    found = orthonormalise(T)
    assert found.dtype == (dtype if dtype.is_floating_point else torch.float32)
    torch.testing.assert_close(found, orthonormalise(T.double()).to(found.dtype))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(orthonormalise(T), found)


def test_orthonormalised_chain_of_poses_stays_rigid() -> None:
    """Rounding errors do not grow when a pose is converted to a keyframe's frame and back many times."""
    keyframe, pose = se3_exp(tangents(1.0, 2))
    step = se3_exp(1e-2 * tangents(1.0, 1)[0])
    step[3, 3] += 2.2e-16
    for _ in range(1000):
        relative = orthonormalise(step @ pose @ invert(keyframe))
        pose = relative @ keyframe
    assert pose[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(pose[:3, :3] @ pose[:3, :3].T, identity, rtol=0, atol=1e-12)


def test_rigid_motions_are_recognised_up_to_a_tolerance() -> None:
    T = se3_exp(tangents(2.0, 6)).reshape(2, 3, 4, 4)
    assert are_rigid(T, 1e-12).tolist() == [[True] * 3] * 2
    for index, wrong in enumerate((2.0, -1.0, torch.nan)):
        T[0, index, :3, :3] *= wrong
    T[1, 0, 3, 0] = 1e-3
    T[1, 1, 0, 0] += 0.005
    assert are_rigid(T, 1e-6).tolist() == [[False] * 3, [False, False, True]]
    assert are_rigid(T, 0.01).tolist() == [[False] * 3, [False, True, True]]
    assert are_rigid(T[1, 2].float(), 1e-5).shape == () and are_rigid(T[:0], 0.01).shape == (0, 3)


def test_interpolation_turns_like_slerp_and_reaches_both_ends() -> None:
    random = torch.Generator().manual_seed(2)
    T = se3_exp(torch.randn(2, 6, dtype=torch.float64, generator=random))
    fraction = torch.tensor([0.0, 0.2, 0.7, 1.0], dtype=torch.float64)
    found = interpolate(T[0], T[1], fraction)
    rotations = Slerp([0, 1], Rotation.from_matrix(T[:, :3, :3].numpy()))(fraction.numpy()).as_matrix()
    torch.testing.assert_close(found[:, :3, :3], torch.from_numpy(rotations), rtol=0, atol=1e-12)
    assert found[0].equal(T[0])
    torch.testing.assert_close(found[-1], T[1], rtol=0, atol=1e-12)


def test_functions_accept_any_batch_shape() -> None:
    xi = tangents(1.0, 6).reshape(2, 3, 6)
    T = se3_exp(xi)
    assert T.shape == (2, 3, 4, 4)
    assert invert(T).shape == (2, 3, 4, 4)
    assert se3_log(T).shape == (2, 3, 6)
    assert torch.equal(se3_log(T)[1, 2], se3_log(T[1, 2]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(5,), (6, 1), ()])
def test_tangent_vectors_of_another_shape_are_rejected(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    with pytest.raises(ShapeError):
        se3_exp(torch.zeros(shape, dtype=dtype))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(3, 3), (16,), (4, 4, 3), (2, 8)])
def test_motions_of_another_shape_are_rejected(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    with pytest.raises(ShapeError):
        se3_log(torch.zeros(shape, dtype=dtype))


@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.0, 3.0])
def test_exp_and_log_gradcheck(angle: float) -> None:
    xi = tangents(angle, 2).requires_grad_()
    assert torch.autograd.gradcheck(se3_exp, xi)
    assert torch.autograd.gradcheck(lambda x: se3_log(se3_exp(x)), xi)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.0])
def test_exp_and_log_have_second_derivatives(angle: float) -> None:
    xi = tangents(angle, 2).requires_grad_()
    assert torch.autograd.gradgradcheck(se3_exp, xi)
    assert torch.autograd.gradgradcheck(lambda x: se3_log(se3_exp(x)), xi)


def test_rotations_that_are_not_finite_do_not_affect_the_others_of_a_batch() -> None:
    T = se3_exp(tangents(1.0, 3))
    T[1, 0, 0] = torch.nan
    T.requires_grad_()
    found = orthonormalise(T)
    assert found[1, :3, :3].isnan().all()
    torch.testing.assert_close(found[::2], T[::2])
    torch.testing.assert_close(orthonormalise(T.detach()), found.detach(), equal_nan=True)
