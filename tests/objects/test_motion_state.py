"""Motion state of a rigid thing whose features have shown a slow motion."""

from __future__ import annotations

import math

import pytest
import torch

from v3d_torch.config import Config
from v3d_torch.objects.feature_shift import FeatureShift
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.objects.motion_record import MotionRecord
from v3d_torch.objects.motion_state import decide_motion_state
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.segmentation.coco import COCO_NAMES

CONFIG = Config().objects
CHAIR = COCO_NAMES.index("chair")
AT_REST, MOVING, UNKNOWN = [0.02, 0.05], [0.02, 0.3], [math.nan, math.nan]


def shifted_chair() -> Track:
    """Chair whose features moved against the camera motion at 1 s."""
    nothing = torch.zeros(0, 0, dtype=torch.bool)
    track = Track(1, 0.0, CONFIG.tracker, *(nothing,) * 2, *(torch.zeros(0, dtype=torch.uint8),) * 2, label=CHAIR)
    track.add_detection(Detection3D(0.0, torch.zeros(3, dtype=torch.float64), torch.rand(60, 3)))
    track.motion.last_shifted, track.motion.is_shifting = 1.0, True
    track.motion.mark_dynamic(1.0)
    return track


@pytest.mark.parametrize(("stamp", "fractions"), [(1.0, UNKNOWN), (1.5, MOVING), (2.5, UNKNOWN), (9.0, MOVING)])
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


@pytest.mark.parametrize("fractions", [[], UNKNOWN])
def test_thing_that_was_pushed_does_not_move_for_ever_if_it_cannot_be_observed(fractions: list[float]) -> None:
    """Such as without the free-space check, or beyond the depth of objects."""
    assert decide_motion_state(shifted_chair(), fractions, 6.5, CONFIG.static_mask) is MotionState.STATIC


def test_evidence_of_motion_in_single_frames_does_not_add_up_over_minutes() -> None:
    """One noisy frame made an object dynamic for a second, if any frame before had been noisy."""
    track = shifted_chair()
    track.motion.mark_at_rest()
    track.motion.mark_dynamic(100.0)
    assert decide_motion_state(track, UNKNOWN, 100.0, CONFIG.static_mask) is MotionState.DYNAMIC
    assert decide_motion_state(track, UNKNOWN, 100.5, CONFIG.static_mask) is MotionState.STATIC
    track.motion.mark_dynamic(100.6)
    assert decide_motion_state(track, UNKNOWN, 101.0, CONFIG.static_mask) is MotionState.DYNAMIC


@pytest.mark.parametrize("rate", [2.0, 3.0, 5.0, 30.0])
def test_features_show_a_motion_at_any_frame_rate(rate: float) -> None:
    elsewhere = torch.zeros(12, 2, dtype=torch.float64)
    record = MotionRecord()
    for frame in range(12):
        record.add_shift(frame / rate, FeatureShift((60 / rate, 0.0), 0.01, elsewhere), 0.3)
    assert record.is_shifting


def test_velocity_is_measured_anew_after_an_absence() -> None:
    """Someone who walked out of view and stands at the same place seconds later moved backwards."""
    nothing = torch.zeros(0, 0, dtype=torch.bool)
    track = Track(1, 0.0, CONFIG.tracker, *(nothing,) * 2, *(torch.zeros(0, dtype=torch.uint8),) * 2, label=0)
    for frame in range(30):
        place = torch.tensor([frame / 30, 0.0, 2.0], dtype=torch.float64)
        track.add_detection(Detection3D(frame / 30, place, torch.rand(60, 3)))
    assert float(track.velocity[0]) > 0.7
    track.restart(6.0)
    track.add_detection(Detection3D(6.0, torch.tensor([1.0, 0.0, 2.0], dtype=torch.float64), torch.rand(60, 3)))
    assert track.velocity.tolist() == [0.0, 0.0, 0.0]


def test_known_position_stays_known_if_newer_detections_have_none() -> None:
    track = shifted_chair()
    nowhere = torch.full((3,), torch.nan, dtype=torch.float64)
    for stamp in (0.5, 1.0, 1.5):
        track.add_detection(Detection3D(stamp, nowhere, torch.rand(3, 3)))
    T_new_old = torch.eye(4, dtype=torch.float64)
    T_new_old[0, 3] = 2.0
    track.apply_world_correction(T_new_old, 0.2)
    assert track.predict_state(1.5).is_known
