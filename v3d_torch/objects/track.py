"""Track of one object over time: detections, class, predicted motion and masks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.objects.kalman_filter import ConstantVelocityKalmanFilter
from v3d_torch.objects.log_ratios import vacated_log_ratio
from v3d_torch.objects.motion_record import MotionRecord
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.segmentation.coco import LIVING, RIGID, UNLABELLED
from v3d_torch.types import STAMP_TOLERANCE

_WHOLE_SIGMA = 0.05
"""Standard deviation between the measured centroid of a fully visible object and its true one, metres: arms and legs
swing by more, and the camera sees one side."""

_PARTIAL_SIGMA = 0.45
"""Additional standard deviation of the centroid if nearly nothing of the object is visible, metres, in proportion to
the hidden part: the centroid of a person who is cut off at the waist is off by a quarter of the body height."""

_VELOCITY_TIME = 0.7
"""Time constant of the velocity of an object that is not observed, seconds: most people stop or turn within a second.
Together with the acceleration noise it implies a speed of about 1 m/s."""

_MAX_EXTRAPOLATION = 0.5
"""Time for which an object without a measured centroid is expected to keep its velocity, seconds: about a step of a
person."""

_MIN_CONFIRMED_SCORE = 0.75
"""Sum of the scores of the detections from which an object is confirmed: one strong detection or some weak ones."""

_CONFIRMING_DYNAMIC_FRAMES = 2
"""Number of frames with evidence of an object's motion that confirm it, whatever its scores."""

_APPEARANCE_RATE = 0.1
"""Weight of the newest colour histogram in the mean of a track, which is that of some ten detections."""

_DETECTION_TIME = 1.0
"""Detections are kept for this long, and one before, seconds: the longest time span of the vote. It bounds memory."""

_STATE_HISTORY, _HISTORY_INTERVAL = 10.0, 0.1 - 1e-3
"""Length of the history of states, and minimum time between two of them, seconds: for planners and drawings."""


@dataclass(frozen=True, eq=False)  # compared by identity
class Detection3D:
    """Detection of an object at one time.

    Attributes:
        stamp: Timestamp, seconds.
        centroid: Centroid, world frame, metres, float64, shape :math:`(3,)`; NaN if the cloud is too small.
        cloud: Point cloud, world frame, metres, float32, shape :math:`(P, 3)`.
    """

    stamp: float
    centroid: Tensor
    cloud: Tensor

    @cached_property
    def has_centroid(self) -> bool:
        """True if the centroid is known."""
        return all(map(math.isfinite, self.centroid.tolist()))

    def transform(self, T_new_old: Tensor) -> Detection3D:
        """Return the detection in another world frame; ``T_new_old`` is float64, shape :math:`(4, 4)`."""
        centroid = T_new_old[:3, :3] @ self.centroid + T_new_old[:3, 3]
        return Detection3D(self.stamp, centroid, transform_points(T_new_old, self.cloud))


@dataclass(eq=False)  # compared by identity, so that a track can be a dictionary key
class Track:
    """One object.

    The detections and the class are measured. A Kalman filter on the centroids predicts the position and the cloud. The
    masks belong to the newest frame and are either measured or predicted, see ``missed``.

    Args:
        config: Noise and maximum speed of the Kalman filter.

    Attributes:
        id: Number of the object, from 1, never reused.
        first_stamp: Timestamp of the first detection, seconds. It starts again after the object was lost, and after a
            gap that is longer than detections are kept.
        mask: Pixels of the object in the newest frame, bool, shape :math:`(H, W)`.
        cloud_pixels: Pixels of the mask whose depth belongs to the object, bool, shape :math:`(H, W)`.
        coarse_mask: Every n-th pixel of the mask, for the tracker's overlaps, packed, uint8, shape :math:`(B,)`.
        coarse_surface: Every n-th pixel of ``cloud_pixels``, packed, uint8, shape :math:`(B,)`.
        missed: True if the object was not detected in the newest frame, so that its masks are predicted.
        is_shown: True if results show the object: it was detected in the newest frame, or is confirmed, was missed for
            a short time only, and the depth shows it at its predicted position.
        detections: Detections of the last second and the one before, newest last.
        labels: Number of detections of each class. Once a detection had a score, those without one do not count.
        label: Class of most detections. A class takes precedence over `UNLABELLED`, however often that was detected.
        total_score: Sum of the scores of all detections.
        appearance: Mean colour histogram, float32, shape :math:`(D,)`; None if unknown.
        appearance_points: Mean number of points of the views in this histogram, with the same weights.
        vacated_time: Time since the last detection for which the predicted place was observed to be empty, seconds.
        vacated_log_ratio: Log-likelihood ratio of the empty place, see `log_ratios.vacated_log_ratio`.
        motion: Times at which there was evidence of its motion.
        history: States of the visible part after detections of the last 10 s, oldest first.
    """

    id: int
    first_stamp: float
    config: InitVar[TrackerConfig]
    mask: Tensor
    cloud_pixels: Tensor
    coarse_mask: Tensor
    coarse_surface: Tensor
    missed: bool = False
    is_shown: bool = True
    detections: list[Detection3D] = field(default_factory=list)
    labels: Counter[int] = field(default_factory=Counter)
    label: int = UNLABELLED
    total_score: float = 0.0
    appearance: Tensor | None = None
    appearance_points: float = 0.0
    vacated_time: float = 0.0
    vacated_log_ratio: float = 0.0
    motion: MotionRecord = field(default_factory=MotionRecord)

    def __post_init__(self, config: TrackerConfig) -> None:
        self.history: list[ObjectState] = []
        self._config = config
        self._filter = ConstantVelocityKalmanFilter(config)
        self._max_points = 1
        self._has_surface_centroid = False  # the position of the visible part is that of its refined mask

    @property
    def newest(self) -> Detection3D:
        """Newest detection."""
        return self.detections[-1]

    @property
    def is_confirmed(self) -> bool:
        """True if scores or motion have shown that the object exists."""
        moved_repeatedly = self.motion.dynamic_frames >= _CONFIRMING_DYNAMIC_FRAMES
        return moved_repeatedly or self.total_score >= _MIN_CONFIRMED_SCORE

    @property
    def may_move(self) -> bool:
        """True if the object may move by itself or has moved; false for furniture that was always at rest."""
        return not self.is_rigid or self.motion.has_moved

    @property
    def has_rigid_label(self) -> bool:
        """True if the class of most detections is that of furniture or another thing without parts that move."""
        return self.label in RIGID

    @property
    def is_rigid(self) -> bool:
        """True for furniture and other things, which move as a whole or not at all, and were never detected as living.

        A person at the border of the image is often detected as furniture.
        """
        return self.has_rigid_label and not self.may_be_living

    @property
    def may_be_living(self) -> bool:
        """True if any detection was that of a person or an animal, whatever the class of most detections."""
        return not LIVING.isdisjoint(self.labels)

    @property
    def velocity(self) -> Tensor:
        """Estimated velocity, world frame, m/s, float64, shape :math:`(3,)`; 0 before the second centroid."""
        return self._filter.state.velocity

    def detection_pair(self, time_span: float, since: float = -torch.inf) -> tuple[Detection3D, Detection3D] | None:
        """Return the newest detection and an earlier one to compare it with.

        Args:
            time_span: Minimum time between both detections, seconds; 0 for the detection before the newest.
            since: Time of the first detection that can be compared, seconds.

        Returns:
            Earlier and newest detection, both with a centroid; None if there is no such pair.
        """
        current = self.newest
        for previous in reversed(self.detections[:-1]):
            if current.stamp - previous.stamp >= time_span - STAMP_TOLERANCE:
                comparable = previous.stamp >= since and previous.has_centroid and current.has_centroid
                return (previous, current) if comparable else None
        return None

    def predict_state(self, stamp: float) -> ObjectState:
        """Predict position and velocity of the whole object with constant velocity (paper, Sec. II).

        Some time after the last measured centroid, for example of an object that is too far for its depth, the velocity
        decays, see `predict_unobserved_state`.

        Args:
            stamp: Timestamp, seconds.
        """
        return self._predict(self._filter.state, stamp)

    def predict_visible_state(self, stamp: float) -> ObjectState:
        """Predict position and velocity of the visible part of the object, like `predict_state`.

        Args:
            stamp: Timestamp, seconds.
        """
        return self._predict(self._filter.visible_state, stamp)

    def motion_to(self, state: ObjectState) -> Tensor:
        """Return how far the newest cloud moves: like the position.

        Args:
            state: Predicted state, see `predict_state`.

        Returns:
            Translation, world frame, metres, float64, shape :math:`(3,)`; 0 before the first centroid.
        """
        motion = state.position - self.predict_state(self.newest.stamp).position
        return motion.nan_to_num(0.0)

    def predict_unobserved_state(self, stamp: float) -> ObjectState:
        """Predict the state of an object that is not observed any more, see `ObjectState.predict_with_decay`.

        An object that cannot move is where it was.

        Args:
            stamp: Timestamp, seconds.
        """
        return self._predict_stop(self._filter.state, stamp)

    def predict_previous_cloud(self) -> Tensor | None:
        """Predict the cloud of the detection before the newest at the time of the newest, with the current velocity.

        Returns:
            Point cloud, world frame, metres, float64, shape :math:`(P, 3)`; None if there is one detection only.
        """
        if len(self.detections) < 2:
            return None
        previous = self.detections[-2]
        return previous.cloud.to(torch.float64) + self.velocity * (self.newest.stamp - previous.stamp)

    def centroid_sigma(self, detection: Detection3D) -> float:
        """Return the standard deviation of the centroid of a detection from that of the whole object, metres.

        It holds for each coordinate.
        """
        fewer, more = sorted((len(detection.cloud), self._max_points))
        return _WHOLE_SIGMA + _PARTIAL_SIGMA * (1 - fewer / more)

    def add_detection(self, detection: Detection3D) -> None:
        """Add a detection, update the Kalman filter, and drop detections that are too old.

        Args:
            detection: Detection, not older than the newest one.
        """
        oldest = detection.stamp - _DETECTION_TIME - STAMP_TOLERANCE
        if self.detections and self.newest.stamp < oldest:  # the object may have moved unobserved, and counts as new
            self.first_stamp = detection.stamp
        self._max_points = max(self._max_points, len(detection.cloud))
        self._filter.update(detection.stamp, detection.centroid, self.centroid_sigma(detection))
        self.vacated_time = self.vacated_log_ratio = 0.0
        self.detections.append(detection)
        oldest_needed = detection.stamp - _DETECTION_TIME + STAMP_TOLERANCE  # one detection before it is kept
        while len(self.detections) > 2 and self.detections[1].stamp <= oldest_needed:
            self.detections.pop(0)

    def record_visible_state(self, surface_centroid: Tensor | None) -> None:
        """Record the state of the visible part after a detection: at the rate of the history, for a limited time.

        Args:
            surface_centroid: Centroid of the surface in the refined mask, world frame, metres, float64, shape
                :math:`(3,)`, which becomes the position; None if the mask was not refined.
        """
        self._has_surface_centroid = surface_centroid is not None and self.newest.has_centroid
        if surface_centroid is not None and self._has_surface_centroid:
            self._filter.correct_visible_position(surface_centroid)
        state = self._filter.visible_state
        if state.is_known and not (self.history and state.stamp - self.history[-1].stamp < _HISTORY_INTERVAL):
            oldest = state.stamp - _STATE_HISTORY
            self.history = [each for each in self.history if each.stamp >= oldest] + [state]

    def add_vacated_time(self, stamp: float, seconds: float) -> None:
        """Record that the predicted place was observed to be empty.

        Args:
            stamp: Timestamp of the observation, seconds.
            seconds: Time for which it was observed.
        """
        self.vacated_time += seconds
        log_ratio = vacated_log_ratio(self.vacated_time, self._filter.state.motion_variance(stamp - self.newest.stamp))
        self.vacated_log_ratio = min(self.vacated_log_ratio, log_ratio)

    def drop_masks(self) -> None:
        """Drop the masks: the object is not detected, and not predicted either."""
        nothing, packed = torch.zeros(0, 0, dtype=torch.bool), torch.zeros(0, dtype=torch.uint8)
        self.set_masks(nothing, nothing, packed, packed, missed=True, is_shown=False)

    def drop_old_detections(self) -> None:
        """Drop all but the newest detection: motion is not measured across a long absence."""
        self.detections = self.detections[-1:]

    def restart(self, stamp: float) -> None:
        """Remove the detections from before the object was lost; motion is measured anew.

        Args:
            stamp: Timestamp of the first detection afterwards, seconds.
        """
        self.first_stamp = stamp
        self.motion.restart()
        self.detections = []
        self._filter = ConstantVelocityKalmanFilter(self._config)

    def update_label(self, label: int, score: float) -> None:
        """Update the class with the class of a detection.

        A propagated mask has the class of the track and score 0: if it counted, a wrong first class would never change.

        Args:
            label: Class index.
            score: Score of the detection; 0 if it has none.
        """
        if score > 0 or self.total_score == 0:  # masks of a user can lack scores
            self.labels[label] += 1
        self.total_score += score
        named = [label for label in self.labels if label != UNLABELLED]
        self.label = max(named or self.labels, key=self.labels.__getitem__)

    def update_appearance(self, histogram: Tensor) -> None:
        """Update the mean colour histogram.

        Args:
            histogram: Colour histogram of the newest detection, float32, shape :math:`(D,)`. NaN is ignored.
        """
        if bool(histogram[0].isnan()):
            return
        if self.appearance is None or len(self.appearance) != len(histogram):  # as after another stage was set
            self.appearance, self.appearance_points = histogram, float(len(self.newest.cloud))
        else:
            self.appearance = self.appearance.lerp(histogram, _APPEARANCE_RATE)
            self.appearance_points += _APPEARANCE_RATE * (len(self.newest.cloud) - self.appearance_points)

    def set_masks(
        self,
        mask: Tensor,
        cloud_pixels: Tensor,
        coarse_mask: Tensor,
        coarse_surface: Tensor,
        *,
        missed: bool,
        is_shown: bool,
    ) -> None:
        """Set the masks of the newest frame.

        Args:
            mask: Pixels of the object, bool, shape :math:`(H, W)`.
            cloud_pixels: Pixels of the mask whose depth belongs to the object, bool, shape :math:`(H, W)`.
            coarse_mask: Every n-th pixel of the mask, packed, uint8, shape :math:`(B,)`.
            coarse_surface: Every n-th pixel of ``cloud_pixels``, packed, uint8, shape :math:`(B,)`.
            missed: True if the masks are predicted, because the object was not detected.
            is_shown: True if results show the object.
        """
        self.mask, self.cloud_pixels = mask, cloud_pixels
        self.coarse_mask, self.coarse_surface = coarse_mask, coarse_surface
        self.missed, self.is_shown = missed, is_shown

    def apply_world_correction(self, T_new_old: Tensor, since: float = -torch.inf) -> None:
        """Transform the track, or what was measured since some time, into the corrected world.

        Args:
            T_new_old: Transform from the old to the corrected world, float64, shape :math:`(4, 4)`.
            since: Time of the first detection that is transformed, seconds.
        """
        self.history = [state.transform(T_new_old) if state.stamp >= since else state for state in self.history]
        self.detections = [d.transform(T_new_old) if d.stamp >= since else d for d in self.detections]
        has_centroid = any(each.has_centroid for each in self.detections if each.stamp >= since)
        if since == -torch.inf or not has_centroid:
            self._filter.apply_world_correction(T_new_old)
        elif self._filter.state.stamp >= since:  # the state combines measurements in both world frames
            shown = self._filter.visible_state.transform(T_new_old)
            self._filter = ConstantVelocityKalmanFilter(self._config)
            for detection in self.detections:
                if detection.stamp >= since:
                    self._filter.update(detection.stamp, detection.centroid, self.centroid_sigma(detection))
            if self._has_surface_centroid:  # the refined mask shows the same place as before
                self._filter.correct_visible_position(shown.position)

    def _predict(self, state: ObjectState, stamp: float) -> ObjectState:
        moving = state.predict(min(stamp, state.stamp + _MAX_EXTRAPOLATION))
        return moving if moving.stamp == stamp else self._predict_stop(moving, stamp)

    def _predict_stop(self, state: ObjectState, stamp: float) -> ObjectState:
        return state.predict_with_decay(stamp, _VELOCITY_TIME) if self.may_move else state.predict_at_rest(stamp)


def predict_clouds(tracks: Sequence[Track], states: Sequence[ObjectState], T_cw: Tensor) -> list[Tensor]:
    """Predict the clouds of tracks in the frame of a camera, see `Track.motion_to`.

    Args:
        tracks: Tracks.
        states: Predicted state of each, see `Track.predict_state`.
        T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.

    Returns:
        Point clouds, camera frame, metres, float64, each of shape :math:`(P, 3)`.
    """
    if not tracks:
        return []
    clouds = [track.newest.cloud for track in tracks]
    counts = [len(cloud) for cloud in clouds]
    motions = torch.stack([track.motion_to(state) for track, state in zip(tracks, states, strict=True)])
    points = torch.cat(clouds).to(torch.float64) + motions.repeat_interleave(torch.tensor(counts), dim=0)
    return list(transform_points(T_cw, points).split(counts))
