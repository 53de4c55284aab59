"""Motion state of an object, from the evidence of its frames (paper, Sec. III-C, III-D, extended in time)."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan

from v3d_torch.config import StaticMaskConfig
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.objects.track import Track
from v3d_torch.types import STAMP_TOLERANCE

_STATIC_FRACTION = 0.1
"""An object is at rest over a time span if less than this fraction of its pixels appeared: contours err by some
hundredths of an object."""

_MIN_MISSED_SCORE = 0.3
"""A missed object that was never dynamic is masked only if the scores of its detections add up to this, two weak ones
or one strong one: the network labels rotated furniture as people in single frames."""

_MAX_UNKNOWN_TIME = 5.0
"""A thing that was pushed counts as moving for at most this long, seconds, if the free-space check does not know its
surface."""

_MIN_SUPPORTED_TIME = 0.3
"""The features on a static object fit the camera motion for at least this long, seconds. Between two frames those on a
person fit it too, if the person walks slowly or along the line of sight."""


def decide_motion_state(
    track: Track, appeared_fractions: Sequence[float], stamp: float, config: StaticMaskConfig
) -> MotionState:
    """Decide the motion state of an object.

    Args:
        track: Track of the object, with the evidence of the frame.
        appeared_fractions: Fraction of the object's pixels that appeared, for each time span of the free-space check;
            NaN if unknown.
        stamp: Timestamp of the frame, seconds.
        config: Times for which evidence counts.
    """
    motion = track.motion
    # A shift counts for a while, because over a short time free space shows no slow motion.
    has_shifted = stamp - motion.last_shifted <= config.hold_dynamic_time
    if motion.last_dynamic == stamp or has_shifted:
        return MotionState.DYNAMIC
    at_rest = [fraction < _STATIC_FRACTION for fraction in appeared_fractions]
    at_rest_over_all = len(at_rest) > 0 and all(at_rest)
    weakly_detected = track.total_score < _MIN_MISSED_SCORE and not motion.has_moved
    if track.missed and (at_rest_over_all or weakly_detected):
        return MotionState.STATIC
    # A walking person pauses, but a rigid thing that is at rest over all known time spans has stopped.
    known = [rest for rest, fraction in zip(at_rest, appeared_fractions, strict=True) if not isnan(fraction)]
    if track.has_rigid_label and known and all(known):
        return MotionState.STATIC
    # Features of a masked object are not matched, so that they cannot show that it still moves.
    is_observed = len(known) > 0 or stamp - motion.last_shifted <= _MAX_UNKNOWN_TIME
    is_shifting = track.has_rigid_label and motion.is_shifting and len(appeared_fractions) > 0 and is_observed
    if is_shifting or is_held_dynamic(track, stamp, config):
        return MotionState.DYNAMIC
    if stamp - motion.last_deforming <= config.hold_dynamic_time:
        return MotionState.DEFORMING
    # Without a centroid, for example because the object is too far for its depth, its motion is never measured.
    is_new = stamp - track.first_stamp < config.confirm_static_time or not track.newest.has_centroid
    is_supported = stamp - motion.supported_since >= _MIN_SUPPORTED_TIME - STAMP_TOLERANCE
    if track.may_be_living and is_new and not at_rest_over_all and not is_supported:
        return MotionState.UNKNOWN
    return MotionState.STATIC


def is_held_dynamic(track: Track, stamp: float, config: StaticMaskConfig) -> bool:
    """Check whether there is evidence of an object's motion now, or was recently and in enough frames.

    Args:
        track: Track of the object, with the evidence of the frame.
        stamp: Timestamp of the frame, seconds.
        config: Times for which evidence counts.
    """
    motion = track.motion
    hold = config.hold_dynamic_time
    is_confirmed = motion.count_dynamic_frames(motion.last_dynamic - hold) >= config.confirm_dynamic_frames
    return (stamp - motion.last_dynamic <= hold and is_confirmed) or motion.last_dynamic == stamp
