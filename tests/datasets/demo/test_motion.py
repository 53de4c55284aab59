"""Motions: camera, key poses, limbs, and the people of the demo."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.demo_views import render_at, world_points
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from v3d_torch.datasets.demo.motions import attach, bend, interpolate, make_pose, move, point_on, span
from v3d_torch.datasets.demo.renderer import Renderer
from v3d_torch.datasets.demo.scenes.walking import TRAJECTORY, WALK_SPEED, sway, walk
from v3d_torch.datasets.demo.sequence import FRAME_COUNT, FRAME_RATE


def visible_centroid(renderer: Renderer, time: float, mask_id: int) -> np.ndarray:
    result = render_at(renderer, time)
    return world_points(result.depth, TRAJECTORY.pose(time))[result.motion_mask.numpy() == mask_id].mean(0)


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
    assert walk(2.0)[0, 3] > walk(1.0)[0, 3]


def test_camera_moves_like_a_hand_held_one() -> None:
    poses = np.stack([TRAJECTORY.pose(i / FRAME_RATE) for i in range(FRAME_COUNT)])
    assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert (np.ptp(poses[:, :3, 3], axis=0) > (0.25, 0.1, 0.06)).all()
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = np.degrees(Rotation.from_matrix(poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]).magnitude())
    assert steps.max() < 0.03 and 0.3 < turns.max() < 1.5


def test_key_values_are_reached_and_left_at_rest() -> None:
    value_at = interpolate([(1.0, (0.0, 2.0)), (2.0, (1.0, 2.0)), (4.0, (1.0, 0.0))])
    assert np.allclose(
        [value_at(t) for t in (0.0, 1.0, 1.5, 2.0, 3.0, 9.0)], [[0, 2], [0, 2], [0.5, 2], [1, 2], [1, 1], [1, 0]]
    )
    speeds = [np.linalg.norm(value_at(t + 1e-3) - value_at(t - 1e-3)) for t in (1.0, 2.0, 4.0)]
    assert max(speeds) < 1e-6


@given(st.tuples(*3 * [st.floats(-0.3, 0.3)]), st.tuples(*3 * [st.floats(-0.3, 0.3)]))
def test_limb_keeps_its_lengths_and_reaches_the_hand(hand: tuple[float, ...], offset: tuple[float, ...]) -> None:
    shoulder, target = np.add(offset, (0.0, 0.0, 1.0)), np.add(hand, (0.3, -0.2, 0.9))
    elbow = bend(lambda t: shoulder, lambda t: target, (0.5, 0.6), (0.1, -0.2, -1.0))(0.0)
    distance = np.linalg.norm(target - shoulder)
    assert np.linalg.norm(elbow - shoulder) == pytest.approx(0.5, abs=1e-9)
    if 0.2 < distance < 1.0:
        assert np.linalg.norm(target - elbow) == pytest.approx(0.6, abs=1e-9)
        T = span(lambda t: shoulder, lambda t: elbow)(0.0)
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9) and np.linalg.det(T[:3, :3]) > 0
        assert np.allclose(T[:3, :3] @ (0.0, 0.0, -0.5) + T[:3, 3], elbow)


def test_joint_stays_on_its_parent() -> None:
    parent = move([(0.0, (0, 0, 0, 0, 0, 0)), (1.0, (1, 0, 0, 90, 0, 0))])
    child = attach(parent, (0.0, 0.0, 2.0), lambda t: np.array((0.0, 30.0 * t, 0.0)))
    for t in (0.0, 0.4, 1.0):
        assert np.allclose(child(t)[:3, 3], point_on(parent, (0.0, 0.0, 2.0))(t))
    assert np.allclose(child(1.0), parent(1.0) @ make_pose((0, 0, 2.0), (0, 30.0, 0)))
