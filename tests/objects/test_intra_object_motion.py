"""Intra-object motion: a body that raises an arm, with a moving camera."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.intra_object_motion import IntraObjectMotion, intra_object_motion


def body(raised: float = 0.0) -> Tensor:
    """Return a torso and an arm that is raised by some metres, (1, N, 3)."""
    generator = torch.Generator().manual_seed(0)
    torso = torch.rand(400, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.4, 0.8, 0.0])
    arm = torch.rand(100, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 0.1, 0.0])
    return torch.cat([torso, arm + torch.tensor([0.4, -raised, 0.0])])[None]


def test_convention_root_mean_nearest_neighbour_distance() -> None:
    previous = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    current = torch.tensor([[[0.0, 2.0, 0.0]]])
    # Mean squares (4 + 5) / 2 and 4 of the two directions; the root of half their sum.
    distance, deforming = intra_object_motion(previous, current, distance_threshold=2.0)
    assert distance.tolist() == pytest.approx([4.25**0.5]) and deforming.tolist() == [True]
    assert intra_object_motion(previous, current, 2.1).deforming.tolist() == [False]
    at_the_threshold = intra_object_motion(current, current + torch.tensor([0.5, 0.0, 0.0]), 0.5)
    assert at_the_threshold.deforming.tolist() == [True]


def test_camera_motion_is_compensated_by_the_transform() -> None:
    T_wa, T_wb = se3_exp(torch.tensor([[0.1, 0.0, -0.2, 0.0, 0.3, 0.1], [0.4, 0.1, 0.0, 0.2, -0.1, 0.0]]).double())
    T_ba = invert(T_wb) @ T_wa
    still, waving = body(), body(raised=0.3)
    world = torch.cat([still, still]), torch.cat([still, waving])
    in_camera = [points @ T[:3, :3] - T[:3, 3] @ T[:3, :3] for points, T in zip(world, (T_wa, T_wb), strict=True)]
    module = IntraObjectMotion(0.025)
    expected = module(*world)
    assert expected.deforming.tolist() == [False, True]
    assert module(*in_camera).deforming.all()  # without the transform everything moves
    for T in (T_ba, T_ba.expand(2, 4, 4)):
        result = module(*in_camera, T_current_previous=T)
        torch.testing.assert_close(result.distance, expected.distance, atol=1e-12, rtol=0)
        assert torch.equal(result.deforming, expected.deforming)
    coarse = module(
        *(points.float() for points in in_camera), T_current_previous=T_ba
    )  # clouds can be float32 with float64 poses
    assert coarse.distance.dtype == torch.float32
    torch.testing.assert_close(coarse.distance.double(), expected.distance, atol=1e-6, rtol=0)


def test_equal_clouds_have_distance_0_and_empty_clouds_nan() -> None:
    previous = body().repeat(2, 1, 1).requires_grad_()
    valid = torch.ones(previous.shape[:2], dtype=torch.bool)
    valid[1] = False
    distance, deforming = intra_object_motion(previous, body().repeat(2, 1, 1), 0.025, valid)
    assert distance[0] == 0 and distance[1].isnan() and not deforming.any()
    distance[0].backward()
    assert previous.grad is not None and not previous.grad.any()  # the root has an infinite slope at 0
