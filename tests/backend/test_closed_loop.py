"""Two laps around the demo room: drift with and without loop closing."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from v3d_torch import V3DSLAM
from v3d_torch.config.loading import load_config
from v3d_torch.datasets.demo import materials
from v3d_torch.datasets.demo.camera_trajectory import R_WC_LEVEL
from v3d_torch.datasets.demo.renderer import Renderer
from v3d_torch.datasets.demo.room import ROOM_MAX, ROOM_MIN
from v3d_torch.datasets.demo.scene import Body, Rectangle, Scene
from v3d_torch.datasets.demo.sensor_model import simulate_colour, simulate_depth
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.types import RGBDFrame, TrackingStatus

CAMERA = PinholeCamera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240, readout=0.0)
FRAMES = 48
"""Frames of one lap: 7.5 degrees and 9.4 cm per frame."""


def true_pose(frame: int) -> np.ndarray:
    """Pose ``T_wc`` on a circle through the demo room, facing outwards, with some sway; both laps are the same."""
    angle = 2 * np.pi * frame / FRAMES
    yaw, pitch = np.degrees(angle) - 90 + 6 * np.sin(3 * angle), -6 + 3 * np.sin(5 * angle)
    roll = 2 * np.sin(4 * angle)
    T_wc = np.eye(4)
    T_wc[:3, :3] = Rotation.from_euler("ZXY", (yaw, pitch, roll), degrees=True).as_matrix() @ R_WC_LEVEL
    T_wc[:3, 3] = 0.7 * np.cos(angle), 0.9 + 0.8 * np.sin(angle), 1.45 + 0.05 * np.sin(3 * angle)
    return T_wc


def without_people(scene: Scene) -> Scene:
    """The demo room without moving people, and with the wall behind the demo's camera."""
    width, height = ROOM_MAX[0] - ROOM_MIN[0], ROOM_MAX[2] - ROOM_MIN[2]
    bricks = materials.bricks(np.random.default_rng(0), width, height, 330, (0.6, 0.5, 0.5))
    back_wall = Rectangle((ROOM_MAX[0], ROOM_MIN[1], ROOM_MAX[2]), (-width, 0, 0), (0, 0, -height), bricks)
    still = [body for body in scene.bodies if not body.is_moving(0.0)]
    return Scene([*still, Body([back_wall])], scene.trajectory)


@pytest.fixture(scope="module")
def frames(walking_scene: Scene) -> list[RGBDFrame]:
    """Frames of two laps, each with different sensor noise."""
    renderer = Renderer(without_people(walking_scene), CAMERA)
    lap = [renderer(true_pose(index), 0.0) for index in range(FRAMES)]
    frames = []
    for index, rendering in enumerate([*lap, *lap]):
        noise = torch.Generator().manual_seed(index)
        colour = simulate_colour(rendering.colour, noise).permute(2, 0, 1).contiguous()
        depth = simulate_depth(rendering.depth, CAMERA, noise).to(torch.float32)[None]
        frames.append(RGBDFrame(index, index / 15, colour, depth, camera=CAMERA))
    return frames


@pytest.fixture(scope="module")
def drift(frames: list[RGBDFrame]) -> dict[bool, float]:
    """Error of the last position relative to the first, as a fraction of the path length, by loop closing on or off."""
    truth = torch.from_numpy(np.stack([true_pose(index) for index in range(2 * FRAMES)]))
    path = float((truth[1:, :3, 3] - truth[:-1, :3, 3]).norm(dim=1).sum())
    drift = {}
    for enabled in (True, False):
        overrides = ("segmentation.source=none", f"loop.enabled={str(enabled).lower()}")
        slam = V3DSLAM(CAMERA, config=load_config(None, overrides))
        for frame in frames:
            slam(frame)
        assert slam.poses.statuses == [TrackingStatus.TRACKED] * len(frames)
        assert (slam.loop_closer.loop_count > 0) is enabled
        estimate = slam.poses.trajectory().T_wc
        error = (invert(estimate[0]) @ estimate[-1])[:3, 3] - (invert(truth[0]) @ truth[-1])[:3, 3]
        drift[enabled] = float(error.norm()) / path
    return drift


def test_loop_closing_removes_drift(drift: dict[bool, float]) -> None:
    assert drift[True] < 0.005


def test_without_loop_closing_drift_remains(drift: dict[bool, float]) -> None:
    assert 0.005 < drift[False] < 0.03
    assert drift[False] > 3 * drift[True]
