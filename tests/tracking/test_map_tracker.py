"""A frame in the local map: its pose, what it finds, and what it should have found but for what hides it."""

from __future__ import annotations

import pytest
import torch
from helpers.sparse_maps import CAMERA, EYE, features
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.tracking.map_tracker import MapTracker, Tracking

COUNT = 400
TUM_LENS = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
LENS = PinholeCamera(fx=517.3, fy=516.5, cx=318.6, cy=255.3, distortion=TUM_LENS)
SIDEWAYS = se3_exp(torch.tensor([0.02, -0.01, 0.01, 0.005, 0.01, -0.01], dtype=torch.float64))


class Wall:
    """A map of features all over the image, 1 to 3 m away, made from the origin."""

    def __init__(self, camera: PinholeCamera = CAMERA) -> None:
        self.config, self.camera = Config(), camera
        self.seen = features(COUNT)
        self.map = SparseMap(self.config.mapping, self.config.features, camera)
        self.first = self.map.insert_keyframe(0, 0.0, EYE, self.seen, torch.full((COUNT,), -1))

    def track(self, seen: Features, T_cw: Tensor, depth: Tensor | None = None) -> Tracking:
        local = self.map.select_landmarks(torch.arange(len(self.map.landmarks)))
        nothing = torch.full((len(seen),), -1)
        found = MapTracker(self.config.tracking, self.config.features, self.camera)(seen, T_cw, local, nothing, depth)
        assert found is not None
        return found

    def left_half(self, nearer: float) -> Tensor:
        """What a depth image shows whose left half is a board, as many metres away; nothing is measured elsewhere."""
        depth = torch.zeros(1, 480, 640)
        depth[..., :320] = nearer
        return depth


def within(pixels: Tensor) -> Tensor:
    return ((pixels >= 0) & (pixels < torch.tensor([640, 480]))).all(dim=1)


def test_the_pose_is_found_from_one_that_is_off() -> None:
    wall = Wall()
    in_camera = wall.camera.back_project(wall.seen.uv, wall.seen.depth) @ SIDEWAYS[:3, :3].T + SIDEWAYS[:3, 3]
    uv, z = CAMERA.project(in_camera), in_camera[:, 2]
    seen = Features(uv, uv.round().long(), z, wall.seen.octave, wall.seen.descriptors)
    found = wall.track(seen, EYE)
    assert se3_log(found.T_cw @ invert(SIDEWAYS)).abs().max() < 1e-6
    inside = within(uv)
    assert inside.sum() > 350
    assert torch.equal(found.landmarks, torch.where(inside, wall.first.landmarks, -1))
    assert set(found.visible.tolist()) == set(wall.first.landmarks[inside].tolist())


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_what_something_nearer_hides_need_not_have_been_seen(camera: PinholeCamera) -> None:
    wall = Wall(camera)
    landmarks, depth = wall.first.landmarks, wall.seen.depth
    assert set(wall.track(wall.seen, EYE).visible.tolist()) == set(landmarks.tolist())
    visible = set(wall.track(wall.seen, EYE, wall.left_half(1.5)).visible.tolist())
    pixel = camera.distort(wall.seen.uv).round()
    left = within(pixel) & (pixel[:, 0] < 320)
    clearly = (1 / 1.5 - 1 / depth) / wall.config.tracking.inverse_depth_sigma  # standard deviations nearer
    hidden, shown = left & (clearly > 2.01), ~left | (clearly < 1.99)
    assert hidden.sum() > 50 and (left & shown).sum() > 50
    assert visible.isdisjoint(landmarks[hidden].tolist())
    assert visible.issuperset(landmarks[shown].tolist())


@pytest.mark.parametrize("told", [True, False], ids=["depth told", "not told"])
def test_who_stands_before_landmarks_for_long_does_not_make_the_map_forget_them(told: bool) -> None:
    wall = Wall()
    left = wall.seen.pixel[:, 0] < 320
    for _ in range(30):
        found = wall.track(wall.seen[~left], EYE, wall.left_half(0.5) if told else None)
        wall.map.count_matches(found.found, found.visible)
    wall.map.insert_keyframe(1, 1.0, EYE, wall.seen[~left], found.landmarks)
    wall.map.cull_landmarks()
    alive = wall.map.landmarks["active"][wall.first.landmarks]
    assert alive[~left].all()
    assert alive[left].all() if told else not alive[left].any()
