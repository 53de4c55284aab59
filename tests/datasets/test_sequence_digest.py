"""Digest of a sequence: what changes it, and what does not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.trajectories import random_walk

from v3d_torch.datasets.demo.sequence import CAMERA
from v3d_torch.datasets.sequence_digest import sequence_digest
from v3d_torch.types import Trajectory

TRUTH = random_walk(8, seed=0)


def sequence(**changes: Any) -> Any:
    values = {"name": "desk", "camera": CAMERA, "stamps": TRUTH.stamps[::2], "groundtruth": TRUTH}
    return SimpleNamespace(**values | changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"camera": replace(CAMERA, depth_scale=1000.0)},
        {"camera": replace(CAMERA, readout=0.02)},
        {"stamps": TRUTH.stamps[1::2]},
        {"stamps": TRUTH.stamps[:6:2]},
        {"groundtruth": None},
        {"groundtruth": Trajectory(TRUTH.stamps + 0.01, TRUTH.T_wc)},
        {"groundtruth": Trajectory(TRUTH.stamps, TRUTH.T_wc.roll(1, 0))},
    ],
    ids=["depth scale", "readout", "other times", "fewer frames", "no truth", "times of the truth", "other poses"],
)
def test_digest_of_another_recording_or_camera_differs(changes: dict[str, Any]) -> None:
    assert sequence_digest(sequence(**changes)) != sequence_digest(sequence())


def test_digest_depends_neither_on_the_name_nor_on_the_last_digits() -> None:
    digest = sequence_digest(sequence())
    assert len(digest) == 64
    rounded = Trajectory(TRUTH.stamps, torch.where(TRUTH.T_wc == 0, TRUTH.T_wc, TRUTH.T_wc * (1 + 1e-15)))
    assert sequence_digest(sequence(name="moved", groundtruth=rounded)) == digest
