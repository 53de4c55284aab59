"""Tracking against the local map: pose, landmarks found, and visible landmarks without the occluded ones."""

from __future__ import annotations

import pytest
import torch
from helpers.sparse_maps import CAMERA, EYE, features
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.mapping.culling import cull_landmarks
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.tracking.map_tracker import MapTracker, MapTracking

COUNT = 400
TUM_LENS = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
LENS = PinholeCamera(fx=517.3, fy=516.5, cx=318.6, cy=255.3, distortion=TUM_LENS)
FISHEYE = PinholeCamera(260, 262, 317.4, 240.4, distortion=(-0.01, 0.02, -0.01, 0.002), distortion_model="equidistant")
SIDEWAYS = se3_exp(torch.tensor([0.02, -0.01, 0.01, 0.005, 0.01, -0.01], dtype=torch.float64))


class MappedWall:
    """Map of one keyframe at the origin, with features all over the image, 1 to 3 m away."""

    def __init__(self, camera: PinholeCamera = CAMERA) -> None:
        self.config, self.camera = Config(), camera
        self.features = features(COUNT)
        self.map = SparseMap(self.config.mapping, self.config.features, camera)
        self.first = self.map.insert_keyframe(0, 0.0, EYE, self.features, torch.full((COUNT,), -1))

    def track(self, observed: Features, T_cw: Tensor, depth: Tensor | None = None) -> MapTracking:
        local_map = self.map.select_landmarks(torch.arange(len(self.map.landmarks)))
        unmatched = torch.full((len(observed),), -1)
        track_map = MapTracker(self.config.tracking, self.config.features, self.camera)
        tracking = track_map(observed, T_cw, local_map, unmatched, depth)
        assert tracking is not None
        return tracking


def board_in_left_half(distance: float) -> Tensor:
    """Depth image with a board in its left half, ``distance`` metres away, and no measurement elsewhere."""
    depth = torch.zeros(1, 480, 640)
    depth[..., :320] = distance
    return depth


def in_image(pixels: Tensor) -> Tensor:
    return ((pixels >= 0) & (pixels < torch.tensor([640, 480]))).all(dim=1)


def test_pose_and_landmarks_are_found_from_an_inexact_prediction() -> None:
    wall = MappedWall()
    in_camera = wall.camera.back_project(wall.features.uv, wall.features.depth) @ SIDEWAYS[:3, :3].T + SIDEWAYS[:3, 3]
    uv, z = CAMERA.project(in_camera), in_camera[:, 2]
    observed = Features(uv, uv.round().long(), z, wall.features.octave, wall.features.descriptors)
    tracking = wall.track(observed, EYE)
    assert se3_log(tracking.T_cw @ invert(SIDEWAYS)).abs().max() < 1e-6
    inside = in_image(uv)
    assert inside.sum() > 350
    assert torch.equal(tracking.landmarks, torch.where(inside, wall.first.landmarks, -1))
    assert set(tracking.visible.tolist()) == set(wall.first.landmarks[inside].tolist())


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_landmarks_behind_a_nearer_surface_are_not_visible(camera: PinholeCamera) -> None:
    wall = MappedWall(camera)
    landmarks, depth = wall.first.landmarks, wall.features.depth
    assert set(wall.track(wall.features, EYE).visible.tolist()) == set(landmarks.tolist())
    visible = set(wall.track(wall.features, EYE, board_in_left_half(1.5)).visible.tolist())
    pixel = camera.distort(wall.features.uv).round()
    left = in_image(pixel) & (pixel[:, 0] < 320)
    sigmas = (1 / 1.5 - 1 / depth) / wall.config.tracking.inverse_depth_sigma  # standard deviations behind the board
    occluded, unoccluded = left & (sigmas > 2.01), ~left | (sigmas < 1.99)
    assert occluded.sum() > 50 and (left & unoccluded).sum() > 50
    assert visible.isdisjoint(landmarks[occluded].tolist())
    assert visible.issuperset(landmarks[unoccluded].tolist())


@pytest.mark.parametrize("with_depth", [True, False], ids=["with depth", "without depth"])
def test_landmarks_occluded_for_many_frames_are_culled_only_without_depth(with_depth: bool) -> None:
    wall = MappedWall()
    left = wall.features.pixel[:, 0] < 320
    for _ in range(30):
        tracking = wall.track(wall.features[~left], EYE, board_in_left_half(0.5) if with_depth else None)
        wall.map.count_matches(tracking.observed_landmarks, tracking.visible)
    wall.map.insert_keyframe(1, 1.0, EYE, wall.features[~left], tracking.landmarks)
    cull_landmarks(wall.map)
    active = wall.map.landmarks["active"][wall.first.landmarks]
    assert active[~left].all()
    assert active[left].all() if with_depth else not active[left].any()


@pytest.mark.parametrize("with_depth", [False, True])
def test_landmarks_that_a_wide_lens_does_not_record_are_not_visible(with_depth: bool) -> None:
    wall = MappedWall(FISHEYE)
    turned = se3_exp(torch.tensor([0, 0, 0, 0, 0.9, 0], dtype=torch.float64))  # landmarks on the right leave the image
    in_camera = wall.camera.back_project(wall.features.uv, wall.features.depth) @ turned[:3, :3].T
    uv, z = FISHEYE.project(in_camera), in_camera[:, 2]
    pixel = FISHEYE.distort(uv)
    inside = in_image(pixel) & (z > 0.05)
    assert 50 < inside.sum() < COUNT - 50
    observed = Features(uv, pixel.round().long(), z, wall.features.octave, wall.features.descriptors)[inside]
    tracking = wall.track(observed, turned, torch.zeros(1, 480, 640) if with_depth else None)
    assert set(tracking.visible.tolist()) == set(wall.first.landmarks[inside].tolist())
