"""Derivatives of the minimum cost of a bundle adjustment, against finite differences."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.bundle_scene import CAMERA, Scene
from torch import Tensor

from v3d_torch.mapping.bundle_adjustment import bundle_adjust
from v3d_torch.mapping.reduced_cost import reduced_cost_derivatives


def test_derivatives_equal_finite_differences_of_the_minimum_cost() -> None:
    """Measurements are shifted along two directions, and poses and points adjusted again."""
    scene = Scene(poses=4, points=40, observers=3)
    observations = scene.observations
    generator = torch.Generator().manual_seed(5)
    uv_jacobian = 5.0 * torch.randn(len(observations.uv), 2, 2, generator=generator).double()
    start = scene.start, scene.start_points

    def adjust(steps: tuple[float, float], start: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, float]:
        uv = observations.uv + uv_jacobian @ torch.tensor(steps).double()
        result = bundle_adjust(
            *start, replace(observations, uv=uv), CAMERA, scene.fixed, iterations=50, tolerance=1e-13
        )
        return result.T_cw, result.points, result.cost_after

    T_cw, points, same = adjust((0.0, 0.0), start)

    def cost(*steps: float) -> float:
        return adjust(steps, (T_cw, points))[2]

    whitened = torch.cat([-uv_jacobian / observations.pixel_sigma[:, None, None], 0 * uv_jacobian[:, :1]], dim=1)
    gradient, hessian = reduced_cost_derivatives(T_cw, points, observations, CAMERA, scene.fixed, whitened)
    assert gradient.shape == (4, 2) and hessian.shape == (4, 2, 2)
    step = 1e-3
    more, less = (torch.tensor([cost(sign * step, 0), cost(0, sign * step)]) for sign in (1, -1))
    mixed = cost(step, step) - cost(step, -step) - cost(-step, step) + cost(-step, -step)
    torch.testing.assert_close(gradient.sum(dim=0), (more - less) / (2 * step), rtol=1e-3, atol=1e-2, check_dtype=False)
    diagonal = (more - 2 * same + less) / step**2
    total = hessian.sum(dim=0)
    torch.testing.assert_close(total.diagonal(), diagonal, rtol=0.05, atol=0, check_dtype=False)
    assert abs(float(total[0, 1]) - mixed / (4 * step**2)) < 0.05 * float(diagonal.min())


def test_parameters_that_poses_explain_have_no_information() -> None:
    """Shifts of all pixels of one image, by a rotation of its camera, do not change the minimum cost."""
    scene = Scene(poses=4, points=60, observers=3, noise=0.0)
    T = scene.T_cw[scene.observations.pose]
    in_camera = (T[:, :3, :3] @ scene.points[scene.observations.point, :, None])[..., 0] + T[:, :3, 3]
    x, y = in_camera[:, 0] / in_camera[:, 2], in_camera[:, 1] / in_camera[:, 2]
    rotated = torch.stack([CAMERA.fx * (1 + x * x), CAMERA.fy * x * y], dim=1)  # about the y axis
    change = (rotated * (scene.observations.pose == 2)[:, None]) / scene.observations.pixel_sigma[:, None]
    inverse_depth = x / in_camera[:, 2] * (scene.observations.pose == 2) * (scene.observations.inverse_depth > 0)
    jacobian = torch.cat([change, inverse_depth[:, None] / scene.observations.inverse_depth_sigma], dim=1)[..., None]
    _, hessian = reduced_cost_derivatives(scene.T_cw, scene.points, scene.observations, CAMERA, scene.fixed, jacobian)
    assert float(hessian.sum().abs()) < 1e-6 * float(jacobian.square().sum())
