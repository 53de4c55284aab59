"""Readout that the map calibrates from the images of a slow camera with a global shutter."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.demo_frames import copy_frames

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.segmentation import MaskFolder
from v3d_torch.slam import V3DSLAM

SLOWNESS = 4
"""Factor of the time between the frames of the demo."""


@pytest.fixture(scope="module")
def readout(tmp_path_factory: pytest.TempPathFactory) -> Readout:
    """Readout after every fourth frame of the demo at a quarter of its speed, with an unknown readout."""
    folder = tmp_path_factory.mktemp("demo")
    copy_frames(folder, range(0, 120, 4))
    sequence, masks = load_sequence(str(folder)), MaskFolder(folder / "masks")
    instances = {SLOWNESS * frame.stamp: masks(frame) for frame in sequence}
    config = load_config(overrides=["mapping.max_keyframe_interval=2"])
    slam = V3DSLAM(replace(sequence.camera, readout=None), lambda frame: instances[frame.stamp], config)
    with torch.inference_mode():
        for frame in sequence:
            slam(replace(frame, stamp=SLOWNESS * frame.stamp, camera=None))
        slam.flush()
    return slam.map.readout


def test_expectation_fades_and_no_readout_is_learnt(readout: Readout) -> None:
    """The expected readout is 20 ms; that of the images is 0."""
    assert abs(readout.seconds) < 0.006


def test_uncertainty_contains_the_true_readout(readout: Readout) -> None:
    assert abs(readout.seconds) < readout.sigma < 0.015
