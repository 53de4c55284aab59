"""Motion of the camera and of the people."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.demo_views import SMALL, render_at, world_points
from scipy.spatial.transform import Rotation

from v3d_torch.datasets.demo.camera_trajectory import camera_pose
from v3d_torch.datasets.demo.people import WALK_SPEED, sway, walk
from v3d_torch.datasets.demo.renderer import Renderer
from v3d_torch.datasets.demo.room import build_room
from v3d_torch.datasets.demo.sequence import FRAME_COUNT, FRAME_RATE, SEED


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(build_room(SEED), SMALL)


def visible_centroid(renderer: Renderer, time: float, mask_id: int) -> np.ndarray:
    result = render_at(renderer, time)
    return world_points(result.depth, camera_pose(time))[result.motion_mask.numpy() == mask_id].mean(0)


def test_walker_moves_and_centroid_of_swayer_stays(renderer: Renderer) -> None:
    """The walker moves at its speed; the swayer changes its shape while its centroid stays within 3 cm."""
    displacement = visible_centroid(renderer, 2.6, 1) - visible_centroid(renderer, 2.3, 1)
    assert displacement[0] == pytest.approx(0.3 * WALK_SPEED, abs=0.03)
    times = np.arange(0.0, 1.1, 0.1)
    centroids = np.stack([visible_centroid(renderer, t, 2) for t in times])
    assert (centroids.std(axis=0) < 0.012).all() and (np.abs(centroids - centroids.mean(0)) < 0.03).all()
    leans = [abs(sway(t).lean) for t in times]
    assert max(leans) * 0.5 > 0.10  # metres at the head, half a metre above the pivot


def test_walker_starts_out_of_view(renderer: Renderer) -> None:
    assert not (render_at(renderer, 0.3).motion_mask == 1).any()
    fractions = [float((render_at(renderer, t).motion_mask == 1).float().mean()) for t in (1.8, 2.4, 2.8)]
    assert all(0.10 < fraction < 0.25 for fraction in fractions)
    assert walk(2.0).shift[0] > walk(1.0).shift[0]


def test_camera_moves_like_a_hand_held_one() -> None:
    poses = np.stack([camera_pose(i / FRAME_RATE) for i in range(FRAME_COUNT)])
    assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert (np.ptp(poses[:, :3, 3], axis=0) > (0.25, 0.1, 0.06)).all()
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = np.degrees(Rotation.from_matrix(poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]).magnitude())
    assert steps.max() < 0.03 and 0.3 < turns.max() < 1.5
