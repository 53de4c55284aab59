"""Renderer: exact depth, visibility, motion masks, and deformation of figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.demo_views import SMALL, render_at, world_points

from v3d_torch.datasets.demo.camera_trajectory import R_WC_LEVEL
from v3d_torch.datasets.demo.motions import make_pose
from v3d_torch.datasets.demo.renderer import Renderer
from v3d_torch.datasets.demo.scene import Body, Box, Deformation, Figure, Rectangle, Scene
from v3d_torch.datasets.demo.scenes import SCENES
from v3d_torch.datasets.demo.scenes.walking import TRAJECTORY
from v3d_torch.datasets.demo.sequence import SEED


def test_static_points_of_one_frame_lie_on_the_surfaces_of_another(renderer: Renderer) -> None:
    """Points are transformed by the true poses of both frames."""
    (first, T_w1), (second, T_w2) = ((render_at(renderer, t), TRAJECTORY.pose(t)) for t in (0.3, 0.8))
    points = world_points(first.depth, T_w1)[first.motion_mask.numpy() == 0]
    points_2 = (points - T_w2[:3, 3]) @ T_w2[:3, :3]
    uv = SMALL.project(torch.from_numpy(points_2)).round().long()
    inside = (uv >= 0).all(1) & (uv < torch.tensor([160, 120])).all(1)
    u, v = uv[inside].T
    error = (second.depth[v, u].numpy() - points_2[inside.numpy(), 2])[second.motion_mask[v, u].numpy() == 0]
    assert abs(np.median(error)) < 1e-3
    assert np.percentile(np.abs(error), 80) < 0.03  # depth is that of the nearest pixel


def test_depth_of_a_slanted_plane_is_exact() -> None:
    """Compare with the closed-form intersection with the plane z = 2 + x / 2."""
    texture = np.full((8, 8, 3), 0.5, np.float32)
    # World axes are those of the camera (x right, y down, z forward).
    plane = Rectangle((-4.0, -4.0, 0.0), (8.0, 0.0, 4.0), (0.0, 8.0, 0.0), texture)
    depth = Renderer(Scene([Body([plane])], TRAJECTORY), SMALL)(np.eye(4), 0.0).depth
    expected = 2.0 / (1.0 - SMALL.rays[..., 0] / 2.0)
    assert torch.allclose(depth, expected, rtol=2e-5)


def test_nearest_surface_occludes_the_others() -> None:
    rectangles = [
        Rectangle((-5.0, -5.0, z), (10.0, 0, 0), (0, 10.0, 0), np.full((8, 8, 3), shade, np.float32))
        for z, shade in ((3.0, 0.2), (2.0, 0.6), (4.0, 0.9))
    ]
    result = Renderer(Scene([Body(rectangles)], TRAJECTORY), SMALL)(np.eye(4), 0.0)
    assert torch.allclose(result.depth, torch.tensor(2.0))
    assert torch.allclose(result.colour, torch.tensor(0.6), atol=1e-6)


@pytest.mark.parametrize("name", SCENES)
def test_motion_masks_contain_all_changed_pixels(name: str, renderer: Renderer) -> None:
    """Render two times from one pose: pixels whose colour changes are in the mask of one of the times."""
    scene = renderer if name == "demo" else Renderer(SCENES[name](SEED), SMALL)
    T_wc = TRAJECTORY.pose(2.0)
    first, second = scene(T_wc, 2.0), scene(T_wc, 2.1)
    changed = (first.colour - second.colour).abs().amax(-1) > 0.02
    moving = (first.motion_mask > 0) | (second.motion_mask > 0)
    dilated = torch.nn.functional.max_pool2d(moving[None].float(), 3, 1, 1)[0] > 0  # antialiased edges
    assert not (changed & ~dilated).any()
    assert float((changed & moving).sum() / moving.sum()) > 0.4
    assert len(first.motion_mask.unique()) >= 3
    assert torch.equal(first.motion_mask, first.instance_mask * (first.motion_mask > 0))


def test_body_that_moves_looks_like_a_body_at_rest_to_a_camera_that_moves() -> None:
    """Depth of a box and a figure that are moved by T, and of the same at rest from a camera that is moved by T^-1."""
    rng = np.random.default_rng(0)
    texture = rng.random((16, 16, 3), np.float32)
    wall = Rectangle((-9, 9.0, 9.0), (18.0, 0, 0), (0, 0, -18.0), texture)
    box = Box((-0.6, 1.8, -0.4), (-0.1, 2.3, 0.3)).closed_faces(texture, texture)
    figure = Figure(np.ones((40, 20, 4), np.float32), (0.3, 2.0, -0.4), 0.8, 0.05)
    T_wb, T_wc = make_pose((0.1, 0.2, -0.05), (25.0, -5.0, 10.0)), np.eye(4)
    T_wc[:3, :3] = R_WC_LEVEL
    moved = Scene([Body([wall]), Body(box, [figure], lambda t: T_wb, instance=3)], TRAJECTORY)
    still = Scene([Body([wall], motion=lambda t: np.linalg.inv(T_wb)), Body(box, [figure], instance=3)], TRAJECTORY)
    first, second = Renderer(moved, SMALL)(T_wc, 0.0), Renderer(still, SMALL)(np.linalg.inv(T_wb) @ T_wc, 0.0)
    assert torch.equal(first.instance_mask, second.instance_mask) and bool((first.instance_mask == 3).any())
    assert torch.allclose(first.depth, second.depth, rtol=1e-4)
    assert torch.allclose(first.colour, second.colour, atol=1e-3)
    assert not (first.motion_mask > 0).any()


def test_figure_leans_about_its_pivot() -> None:
    """The rows above and below the pivot move sideways as the geometry predicts; the row of the pivot stays."""
    rgba = np.ones((100, 50, 4), np.float32)
    wall = Rectangle((-5, 4.0, 5.0), (10.0, 0, 0), (0, 0, -10.0), np.zeros((8, 8, 3), np.float32))
    figure = Figure(rgba, (0.0, 2.0, -0.5), 1.0, 0.001, pivot=(0.5, 0.5))
    T_wc = np.eye(4)
    T_wc[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    mean_columns = []
    for lean in (0.0, 0.4):
        leaning = replace(figure, deformation=lambda t, lean=lean: Deformation(lean=lean))
        scene = Scene([Body([wall]), Body(figures=[leaning], instance=7)], TRAJECTORY)
        mask = Renderer(scene, SMALL)(T_wc, 0.0).instance_mask
        mean_columns.append([float(torch.nonzero(mask[row] == 7).float().mean()) for row in (30, 59, 88)])
    top, middle, bottom = np.subtract(mean_columns[1], mean_columns[0])
    expected = 0.4 * 29.5 / SMALL.fy * 2.0 * SMALL.fx / 2.0
    assert top == pytest.approx(expected, abs=1.0) and bottom == pytest.approx(-expected, abs=1.0)
    assert middle == pytest.approx(0.0, abs=0.6)
