"""Benchmark of tracks: errors of positions and velocities of a person who walks before a turning camera."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(fx=60.0, fy=60.0, cx=39.5, cy=29.5, width=80, height=60)
OFFSET = torch.tensor([0.03, 0.0, 0.04], dtype=torch.float64)
"""Error of the tracked position, 5 cm."""

POSITION_VARIANCE, VELOCITY_VARIANCE = 0.0025, 0.04
"""Variances that the track states: (5 cm)² and (20 cm/s)²."""


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))


@pytest.mark.usefixtures("modules")
def test_errors_are_those_of_the_track_in_any_world() -> None:
    motion, scores = __import__("track_evaluation.motion").motion, sys.modules["track_evaluation.scores"]
    people_class = sys.modules["track_evaluation.truth"].TruePeople
    T_eg = se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.3, -0.2, 0.1], dtype=torch.float64))
    stamps = torch.arange(20, dtype=torch.float64) / 8
    T_gc = se3_exp(stamps[:, None] * torch.tensor([0.0, 0.0, 0.0, 0.0, 0.1, 0.0], dtype=torch.float64))
    errors = motion.MotionErrors(CAMERA.rays.numpy(), Trajectory(stamps, T_gc))
    velocity = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
    position_errors, seen = [], []
    for stamp, T in zip(stamps.tolist(), T_gc, strict=True):
        place = torch.tensor([-0.5, 0.0, 3.0], dtype=torch.float64) + velocity * stamp  # ground-truth world
        centre = invert(T)[:3, :3] @ place + invert(T)[:3, 3]
        u, v = (60 * centre[:2] / centre[2]).tolist()
        row, column = round(29.5 + v), round(39.5 + u)
        owner = np.zeros((60, 80), np.uint8)
        owner[row - 12 : row + 13, column - 5 : column + 6] = 1
        shown = torch.tensor([(column - 39.5) / 60, (row - 29.5) / 60, 1.0], dtype=torch.float64) * centre[2]
        position_errors.append(invert(T)[:3, :3] @ OFFSET + centre - shown)
        seen.append(T[:3, :3] @ shown)
        depth = torch.full((1, 60, 80), 5.0)
        depth[0, torch.from_numpy(owner == 1)] = float(centre[2])
        state = ObjectState(
            stamp,
            T_eg[:3, :3] @ (place + OFFSET) + T_eg[:3, 3],
            T_eg[:3, :3] @ velocity,
            (POSITION_VARIANCE, 0.0, VELOCITY_VARIANCE),
            2.0,
        )
        overlap = scores.FrameOverlap((4,), (9,), np.ones((1, 1)), np.ones((1, 1), np.int64), np.ones(1, np.int64))
        errors.add(people_class(stamp, owner, (4,)), depth, overlap, {9: state}, T_eg @ T)
    found = errors.scores()
    assert found.count == 20
    assert found.position == pytest.approx(0.05, abs=0.03)  # a pixel is 5 cm
    assert found.velocity == pytest.approx(0.0, abs=0.12)
    assert found.velocity_from_truth == pytest.approx(0.0, abs=0.12)
    # The true positions are those of the pixels. The true velocity is that from two frames before to two frames after.
    # The first and the last velocity are those of three frames.
    frame = torch.arange(1, 19)
    before, after = (frame - 2).clamp(min=0), (frame + 2).clamp(max=19)
    travelled = torch.stack(seen)[after] - torch.stack(seen)[before]
    velocity_errors = velocity - travelled / (stamps[after] - stamps[before])[:, None]
    position_nees = float(torch.stack(position_errors).square().sum(dim=1).mean()) / POSITION_VARIANCE
    velocity_nees = float(velocity_errors.square().sum(dim=1).mean()) / VELOCITY_VARIANCE
    assert found.position_nees == pytest.approx(position_nees, rel=1e-3)
    assert found.velocity_nees == pytest.approx(velocity_nees, rel=1e-3)
