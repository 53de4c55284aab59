"""Motion state of a rigid thing whose features have shown a slow motion."""

from __future__ import annotations

import math

import pytest
import torch

from v3d_torch.config import Config
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.objects.motion_state import decide_motion_state
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.segmentation.coco import COCO_NAMES

CONFIG = Config().objects
CHAIR = COCO_NAMES.index("chair")
AT_REST, MOVING, UNKNOWN = [0.02, 0.05], [0.02, 0.3], [math.nan, math.nan]


def shifted_chair() -> Track:
    """Chair whose features moved against the camera motion at 1 s."""
    nothing = torch.zeros(0, 0, dtype=torch.bool)
    track = Track(1, 0.0, CONFIG.tracker, nothing, nothing, torch.zeros(0, dtype=torch.uint8), label=CHAIR)
    track.add_detection(Detection3D(0.0, torch.zeros(3, dtype=torch.float64), torch.rand(60, 3)))
    track.motion.last_shifted, track.motion.is_shifting = 1.0, True
    track.motion.mark_dynamic(1.0)
    return track


@pytest.mark.parametrize("stamp", [1.0, 1.5, 2.5, 9.0])
@pytest.mark.parametrize("fractions", [MOVING, UNKNOWN])
def test_thing_that_was_pushed_is_dynamic_until_it_is_observed_at_rest(stamp: float, fractions: list[float]) -> None:
    """It was static again after a second, because the features of a masked object are not matched."""
    assert decide_motion_state(shifted_chair(), fractions, stamp, CONFIG.static_mask) is MotionState.DYNAMIC


def test_thing_that_was_pushed_is_static_once_it_is_observed_at_rest() -> None:
    track = shifted_chair()
    assert decide_motion_state(track, AT_REST, 1.5, CONFIG.static_mask) is MotionState.DYNAMIC  # too slow to be seen
    assert decide_motion_state(track, AT_REST, 2.5, CONFIG.static_mask) is MotionState.STATIC
    track.motion.mark_at_rest()
    assert decide_motion_state(track, UNKNOWN, 3.0, CONFIG.static_mask) is MotionState.STATIC


def test_shift_from_before_an_absence_does_not_count() -> None:
    track = shifted_chair()
    track.restart(5.0)
    track.add_detection(Detection3D(5.0, torch.zeros(3, dtype=torch.float64), torch.rand(60, 3)))
    assert decide_motion_state(track, UNKNOWN, 5.0, CONFIG.static_mask) is MotionState.STATIC
