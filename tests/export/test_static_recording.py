"""Recordings of the static scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import torch
from helpers.posed_images import CAMERA, T_WC, posed_images

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.export.static_recording import StaticRecording
from v3d_torch.types import Trajectory


def test_recording_is_a_sequence_without_depth_where_something_moves(tmp_path: Path) -> None:
    images = posed_images()
    with TUMWriter(tmp_path / "out", CAMERA) as writer:
        recording = StaticRecording(writer)
        for image in images:
            recording.add(image.frame, image.static)
        recording.write_poses(Trajectory([0.0, 0.1], T_WC))
    sequence = load_sequence(str(tmp_path / "out"))
    assert sequence.camera == replace(CAMERA, depth_scale=5000.0) and sequence.groundtruth is None
    for frame, image in zip(sequence, images, strict=True):
        assert torch.equal(frame.image, image.frame.image)
        torch.testing.assert_close(frame.depth, image.static_depth, rtol=0, atol=0.0001)
        moving = cv2.imread(str(tmp_path / "out" / "moving" / f"{frame.stamp:.6f}.png"), cv2.IMREAD_UNCHANGED)
        assert (torch.from_numpy(moving) == (~image.static).byte() * 255).all()
    estimate = read_trajectory(tmp_path / "out" / "estimated_trajectory.txt")
    torch.testing.assert_close(estimate.T_wc, T_WC, rtol=0, atol=1e-8)


def test_measured_gravity_is_kept(tmp_path: Path) -> None:
    (image, *_) = posed_images()
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    with TUMWriter(tmp_path / "out", CAMERA) as writer:
        StaticRecording(writer).add(replace(image.frame, gravity=down), image.static)
    gravity = load_sequence(str(tmp_path / "out"))[0].gravity
    assert gravity is not None and torch.equal(gravity, down)


def test_masks_are_not_taken_for_true_masks(tmp_path: Path) -> None:
    (image, *_) = posed_images()
    with TUMWriter(tmp_path / "out", CAMERA) as writer:
        StaticRecording(writer).add(image.frame, image.static)
    assert load_sequence(str(tmp_path / "out")).motion_mask(0) is None
