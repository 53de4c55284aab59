"""Record of the frames that show a motion of one object."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from v3d_torch.objects.feature_shift import FeatureShift, sum_shifts
from v3d_torch.types import STAMP_TOLERANCE

_MIN_SHIFT_TIME = 1 / 3
"""Minimum time over which shifts have been added up, as a fraction of the whole: the features of a single frame can all
be matched wrongly, on a repeated pattern."""


_MAX_INTERVAL = 1.0
"""Maximum time between two frames whose shifts are added up, seconds."""

_COUNTED_FRAMES = 100
"""Number of frames with a motion whose times are kept: the maximum of ``static_mask.confirm_dynamic_frames``."""


@dataclass
class MotionRecord:
    """Times at which there was evidence that an object moves or is at rest.

    Attributes:
        dynamic_frames: Number of frames in which free space, votes or features showed a motion of the object.
        last_dynamic: Timestamp of the last of these frames, seconds.
        last_shifted: Timestamp of the last frame in which its features had moved against the camera motion, seconds.
        is_shifting: True from such a frame until the object is observed at rest.
        last_deforming: Timestamp of the last frame in which the object deformed, see `chamfer_evidence`, seconds.
        supported_since: Timestamp of the first of the consecutive frames, up to the newest, in which its features fit
            the camera motion, seconds; infinity if they do not fit in the newest frame.
    """

    dynamic_frames: int = 0
    last_dynamic: float = -inf
    last_shifted: float = -inf
    is_shifting: bool = False
    last_deforming: float = -inf
    supported_since: float = inf
    _shifts: list[tuple[float, FeatureShift]] = field(default_factory=list)  # by the time of the frame
    _dynamic_stamps: list[float] = field(default_factory=list)  # of the last frames that showed a motion

    @property
    def has_moved(self) -> bool:
        """True if a motion of the object was ever observed."""
        return self.last_dynamic > -inf

    def mark_dynamic(self, stamp: float) -> None:
        """Record that the frame at ``stamp``, seconds, shows a motion of the object."""
        self.last_dynamic = stamp
        self.dynamic_frames += 1
        self._dynamic_stamps = [*self._dynamic_stamps[1 - _COUNTED_FRAMES :], stamp]

    def count_dynamic_frames(self, since: float) -> int:
        """Count the frames since a time, seconds, that show a motion of the object; only the last 100 are known."""
        return sum(each >= since for each in self._dynamic_stamps)

    def mark_deforming(self, stamp: float) -> None:
        """Record that the object deforms in the frame at ``stamp``, seconds."""
        self.last_deforming = stamp

    def mark_supported(self, stamp: float, is_supported: bool) -> None:
        """Record whether the features on the object fit the camera motion in the frame at ``stamp``, seconds."""
        self.supported_since = min(self.supported_since, stamp) if is_supported else inf

    def add_shift(self, stamp: float, shift: FeatureShift | None, time_span: float) -> None:
        """Add the shift of the features on the object in a frame, and record a motion if the sum shows one.

        Args:
            stamp: Timestamp of the frame, seconds.
            shift: Shift since the previous frame; None if it is not known.
            time_span: Time over which shifts are added up, seconds.
        """
        # The last shift is kept for longer, so that there are two at a low frame rate.
        recent = [each for each in self._shifts[:-1] if stamp - each[0] < time_span + STAMP_TOLERANCE]
        last = [each for each in self._shifts[-1:] if stamp - each[0] < max(time_span, _MAX_INTERVAL) + STAMP_TOLERANCE]
        self._shifts = recent + last
        if shift is None:
            return
        self._shifts.append((stamp, shift))
        is_long = stamp - self._shifts[0][0] >= _MIN_SHIFT_TIME * time_span - STAMP_TOLERANCE
        if is_long and sum_shifts(each for _, each in self._shifts).is_motion:
            self.last_shifted, self.is_shifting = stamp, True

    def mark_at_rest(self) -> None:
        """Record that the object is observed at rest."""
        self.is_shifting = False

    def restart(self) -> None:
        """Forget what is measured over consecutive frames, because the object was lost in between."""
        self.supported_since, self.is_shifting = inf, False
        self._shifts = []
