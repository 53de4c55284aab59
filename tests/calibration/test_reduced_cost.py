"""Derivatives of the minimum cost of a bundle adjustment, against finite differences."""

from __future__ import annotations

import torch
from helpers.bundle_scenes import CAMERA, Scene
from torch import Tensor

from v3d_torch.calibration.reduced_cost import differentiate_minimum_cost
from v3d_torch.mapping.bundle_problem import prepare_bundle


def differentiate(scene: Scene, T_cw: Tensor, points: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor]:
    problem, state, _ = prepare_bundle(T_cw, points, **scene.observations, weights=None, valid=None)
    return differentiate_minimum_cost(problem, state, jacobian)


def test_derivatives_equal_finite_differences_of_the_minimum_cost() -> None:
    """Measurements are shifted along two directions, and poses and points adjusted again."""
    scene = Scene(poses=4, points=40, observers=3)
    generator = torch.Generator().manual_seed(5)
    by_parameter = 5.0 * torch.randn(len(scene.pose), 2, 2, generator=generator).double()
    optimum = scene.adjust(iterations=50, tolerance=1e-13)

    def cost(*steps: float) -> float:
        uv = scene.measured.uv + by_parameter @ torch.tensor(steps).double()
        moved = {"T_cw": optimum.T_cw, "points": optimum.points, "uv": uv}
        return float(scene.adjust(**moved, iterations=50, tolerance=1e-13).cost_after)

    whitened = -by_parameter.permute(2, 1, 0) / scene.measured.pixel_sigma
    jacobian = torch.cat([whitened, 0 * whitened[:, :1]], dim=1)
    gradient, hessian = differentiate(scene, optimum.T_cw, optimum.points, jacobian)
    assert gradient.shape == (4, 2) and hessian.shape == (4, 2, 2)
    step = 1e-3
    more, less = (torch.tensor([cost(sign * step, 0), cost(0, sign * step)]) for sign in (1, -1))
    mixed = cost(step, step) - cost(step, -step) - cost(-step, step) + cost(-step, -step)
    torch.testing.assert_close(gradient.sum(dim=0), (more - less) / (2 * step), rtol=1e-3, atol=1e-2, check_dtype=False)
    diagonal = (more - 2 * cost(0.0, 0.0) + less) / step**2
    total = hessian.sum(dim=0)
    torch.testing.assert_close(total.diagonal(), diagonal, rtol=0.05, atol=0, check_dtype=False)
    assert abs(float(total[0, 1]) - mixed / (4 * step**2)) < 0.05 * float(diagonal.min())


def test_parameters_that_poses_explain_have_no_information() -> None:
    """Shifts of all pixels of one image, by a rotation of its camera, do not change the minimum cost."""
    scene = Scene(poses=4, points=60, observers=3, noise=0.0)
    T = scene.T_cw[scene.pose]
    in_camera = (T[:, :3, :3] @ scene.points[scene.point, :, None])[..., 0] + T[:, :3, 3]
    x, y = in_camera[:, 0] / in_camera[:, 2], in_camera[:, 1] / in_camera[:, 2]
    rotated = torch.stack([CAMERA.fx * (1 + x * x), CAMERA.fy * x * y])  # about the y axis
    is_moved = scene.pose == 2
    inverse_depth = x / in_camera[:, 2] * is_moved * (scene.measured.inverse_depth > 0)
    by_uv = rotated * is_moved / scene.measured.pixel_sigma
    jacobian = torch.cat([by_uv, inverse_depth[None] / scene.measured.inverse_depth_sigma])[None]
    _, hessian = differentiate(scene, scene.T_cw, scene.points, jacobian)
    assert float(hessian.sum().abs()) < 1e-6 * float(jacobian.square().sum())
