"""Multi-object tracking: object ids by optimal assignment, and prediction of missed objects (paper, Sec. II)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from v3d_torch.config import CloudConfig, TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.packed_masks import count_common_pixels, count_pixels, pack_masks
from v3d_torch.geometry.se3 import invert
from v3d_torch.objects.assignment import match_instances
from v3d_torch.objects.image_scale import coarse_stride
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.objects.mask_propagation import predict_mask
from v3d_torch.objects.track import Track
from v3d_torch.objects.track_matching import (
    DetectedInstances,
    PredictedTracks,
    compare_tracks,
    predict_tracks,
    to_detections,
)
from v3d_torch.segmentation.coco import UNLABELLED
from v3d_torch.types import STAMP_TOLERANCE, Instances

_MIN_COARSE_PIXELS = 4
"""Minimum number of pixels of its coarse mask with which an instance starts a track: no overlap can be measured with
fewer."""

_DUPLICATE_COVERAGE = 0.7
"""Minimum overlap of an unmatched instance with a matched one of its class from which both are the same object, as a
fraction of the smaller mask: the network finds a person and also a part of this person."""

_DUPLICATE_DISTANCE = 0.5
"""Maximum distance of the centroids of two detections of an object, metres."""

_MIN_VACATED_FRACTION = 0.5
"""A missed object has vacated its predicted place if the depth is behind more than this fraction of its points."""

_MIN_COVERED_FRACTION = 0.4
"""A missed object is behind a detected one whose surface covers more than this fraction of its predicted mask."""

_MAX_SHOWN_TIME = 0.1
"""A missed object is shown for this long, seconds: an object that is missed for longer is mostly hidden or has
turned, so that its predicted mask is wrong. Camera tracking still leaves out the pixels of all predicted masks."""

_MAX_OBSERVED_TIME = 0.2
"""Time before a frame for which the frame shows what was there, seconds: what happened in a longer gap is unknown."""


class InstanceTracker(torch.nn.Module):
    """Assignment of object ids to the instances of each frame.

    The instances of a frame continue tracks in four passes, each an optimal assignment. Instances with a class continue
    confirmed, resting and lost tracks with a class, then all other tracks. Instances without a class continue tracks
    without a class, then those with one. An instance that was propagated continues its own track.

    If an object is not detected any more and may move, its mask is predicted for a short time. An object that does not
    move has no mask in this time, because camera tracking uses its pixels; it is called resting. Afterwards both are
    lost: confirmed ones keep their ids for some seconds, in case they were hidden or out of view. The state (tracks and
    next id) is part of ``state_dict()``.

    Args:
        config: Gates and times.
        camera: Camera of all frames.
        clouds: Spacing and maximum depth of the points of the clouds.

    Attributes:
        tracks: Tracks that were detected in the newest frame, or may move, are not covered by a detected object of
            their class and were missed for at most the maximum time.
        resting: Missed tracks of furniture that was never observed to move, for at most the maximum time.
        lost: Confirmed tracks that were missed for longer, or whose place another object occupies.
        last_stamp: Timestamp of the last frame, seconds; -infinity before the first one.
        comparable_since: Time of the first detection that can be compared with the newest ones, seconds: before it, a
            motion of the camera was not measured.
    """

    def __init__(self, config: TrackerConfig, camera: PinholeCamera, clouds: CloudConfig) -> None:
        super().__init__()
        self._config = config
        self._camera = camera
        self._clouds = clouds
        self._stride = coarse_stride(camera)
        self._next_id = 1
        self.last_stamp = -torch.inf
        self.tracks: list[Track] = []
        self.resting: list[Track] = []
        self.lost: list[Track] = []
        self.comparable_since = -torch.inf
        self._guessed_since: float | None = None  # the world frame of the detections since then is a guess

    def get_extra_state(self) -> dict[str, Any]:
        """Return the tracks and the next id, for ``state_dict()``.

        The tracks are those of the tracker, not copies: copy or save the state before the next frame changes them.
        """
        return {
            "tracks": list(self.tracks),
            "resting": list(self.resting),
            "lost": list(self.lost),
            "next_id": self._next_id,
            "last_stamp": self.last_stamp,
            "comparable_since": self.comparable_since,
            "guessed_since": self._guessed_since,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Replace the tracks and the next id, for ``load_state_dict()``.

        Args:
            state: Result of `get_extra_state`.
        """
        self.tracks, self.resting = list(state["tracks"]), list(state["resting"])
        self.lost = list(state["lost"])
        self._next_id, self.last_stamp = state["next_id"], state["last_stamp"]
        self.comparable_since, self._guessed_since = state["comparable_since"], state["guessed_since"]

    def forward(
        self,
        stamp: float,
        instances: Instances,
        clouds: InstanceClouds,
        depth: Tensor,
        T_wc: Tensor,
        appearance: Tensor | None = None,
    ) -> list[Track]:
        """Update the tracks with a frame.

        Args:
            stamp: Timestamp, seconds.
            instances: Instances of the frame, by descending score.
            clouds: Clouds of the instances, camera frame.
            depth: Depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.
            T_wc: Estimated camera-to-world pose, float64, shape :math:`(4, 4)`.
            appearance: Colour histograms of the instances, float32, shape :math:`(N, D)`; None if unknown.

        Returns:
            ``tracks``, sorted by id.
        """
        camera, stride = self._camera, self._stride
        compared = appearance if self._config.compare_appearance else None
        detected = to_detections(stamp, instances, clouds, compared, T_wc, stride)
        matches = self._continued_tracks(instances)
        others = [track for track in self.tracks if track not in matches.values()]
        predicted = predict_tracks(others, stamp, depth, invert(T_wc), camera, self._clouds, stride)
        matches |= self._match(predicted, detected, matches)

        # Update matched tracks, and start a track for each instance without a match, unless it shows a matched object
        # or is tiny, such as the rest of a person who goes behind another.
        updated: dict[int, Track] = {}
        is_tiny = (count_pixels(detected.coarse_masks) < _MIN_COARSE_PIXELS).tolist()
        labels, scores = instances.labels.tolist(), instances.scores.tolist()
        for i, detection in enumerate(detected.detections):
            track = matches.get(i)
            if track is None and (is_tiny[i] or self._is_duplicate(i, matches, detected)):
                continue
            pixels = instances.masks[i], clouds.cloud_pixels[i]
            masks = *pixels, detected.coarse_masks[i], detected.coarse_surfaces[i]
            track = matches[i] = track or self._start_track(stamp, masks)
            track.add_detection(detection)
            track.set_masks(*masks, missed=False, is_shown=True)
            track.update_label(labels[i], scores[i])
            if detected.appearance is not None:
                track.update_appearance(detected.appearance[i])
            updated[i] = track

        missed = self._predict_missed_tracks(stamp, depth, predicted, detected, updated)
        self.tracks = sorted([*updated.values(), *missed], key=lambda track: track.id)
        self.last_stamp = stamp
        return list(self.tracks)

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform all tracks into the corrected world.

        Args:
            T_new_old: Transform from the old to the corrected world, float64, shape :math:`(4, 4)`.
        """
        for track in (*self.tracks, *self.resting, *self.lost):
            track.apply_world_correction(T_new_old)

    def start_guessed_world(self, stamp: float) -> None:
        """Record that the motion of the camera before a frame was not measured.

        Detections from now on are not compared with earlier ones, and their world frame is not that of the map until
        `move_to_map`. This holds for the first frame, too, which can be found in a known map.

        Args:
            stamp: Timestamp of the frame, seconds.
        """
        if self.last_stamp > -torch.inf:  # else there is nothing to compare with
            self.comparable_since = stamp
        if self._guessed_since is None:
            self._guessed_since = stamp

    def move_to_map(self, T_new_old: Tensor, *, all_tracks: bool = False) -> None:
        """Transform the detections since the first `start_guessed_world` into the world frame of the map.

        Args:
            T_new_old: Transform from the world frame of these detections to that of the map, float64, shape
                :math:`(4, 4)`.
            all_tracks: True to transform all detections, because they were made in another part of the map.
        """
        if all_tracks:
            self.apply_world_correction(T_new_old)
        elif self._guessed_since is not None:
            for track in (*self.tracks, *self.resting, *self.lost):
                track.apply_world_correction(T_new_old, self._guessed_since)
        self._guessed_since = None

    def _continued_tracks(self, instances: Instances) -> dict[int, Track]:
        """Return the track of each instance of which it is known, by its index."""
        if instances.track_ids is None:
            return {}
        tracks = {track.id: track for track in self.tracks}
        return {i: tracks[track_id] for i, track_id in enumerate(instances.track_ids.tolist()) if track_id > 0}

    def _match(
        self, predicted: PredictedTracks, detected: DetectedInstances, matched: Collection[int]
    ) -> dict[int, Track]:
        """Match instances to tracks in four passes.

        Args:
            predicted: Tracks to match.
            detected: Instances.
            matched: Indices of instances whose track is known.

        Returns:
            Track of each other instance that continues one, by its index.
        """
        if len(detected) == len(matched):
            return {}
        labels = set(detected.labels.tolist())  # an instance continues a track without a mask only if it has its class
        without_masks = [track for track in (*self.resting, *self.lost) if track.label in labels]
        tracks = [*predicted.tracks, *without_masks]
        log_ratio = compare_tracks(predicted, without_masks, detected, self._config)
        instance_has_class = detected.labels != UNLABELLED
        track_has_class = torch.tensor([track.label != UNLABELLED for track in tracks], dtype=torch.bool)
        first_choice = torch.tensor([track.is_confirmed or track in self.resting for track in tracks], dtype=torch.bool)
        free_instances = torch.tensor([j not in matched for j in range(len(detected))])
        free_tracks = torch.ones(len(tracks), dtype=torch.bool)
        matches: dict[int, Track] = {}

        def assign(rows: Tensor, columns: Tensor) -> None:
            for i, j in _assign(log_ratio, rows & free_tracks, columns & free_instances):
                matches[j] = tracks[i]
                free_tracks[i], free_instances[j] = False, False

        assign(track_has_class & first_choice, instance_has_class)
        assign(~(track_has_class & first_choice), instance_has_class)
        assign(~track_has_class, ~instance_has_class)
        assign(track_has_class, ~instance_has_class)
        self._restart_tracks(matches.values(), detected.stamp)
        return matches

    def _restart_tracks(self, matched: Iterable[Track], stamp: float) -> None:
        """Track the matched ones of the resting and lost tracks again."""
        for track in matched:
            if track in self.lost:
                track.restart(stamp)
                self.lost.remove(track)
            elif track in self.resting:
                self.resting.remove(track)

    def _is_duplicate(self, i: int, matches: dict[int, Track], detected: DetectedInstances) -> bool:
        """Check whether an instance shows the object of a matched instance of the same class, or a part of it."""
        centroid, mask = detected.detections[i].centroid, detected.coarse_masks[i : i + 1]
        common = count_common_pixels(mask, detected.coarse_masks)[0]
        smaller = torch.minimum(count_pixels(mask), count_pixels(detected.coarse_masks))
        contained = common > _DUPLICATE_COVERAGE * smaller
        return any(
            bool(contained[j])
            and detected.labels[j] == detected.labels[i]
            and not float((centroid - detected.detections[j].centroid).norm()) > _DUPLICATE_DISTANCE
            for j in matches
        )

    def _start_track(self, stamp: float, masks: tuple[Tensor, Tensor, Tensor, Tensor]) -> Track:
        """Return a new track with the next id."""
        track = Track(self._next_id, stamp, self._config, *masks)
        self._next_id += 1
        return track

    def _predict_missed_tracks(
        self,
        stamp: float,
        depth: Tensor,
        predicted: PredictedTracks,
        detected: DetectedInstances,
        updated: Mapping[int, Track],
    ) -> list[Track]:
        """Predict the masks of the missed tracks that may move and are not lost; return these."""
        missed, resting, lost = [], list(self.resting), []
        has_depth = torch.from_numpy(depth[0].numpy() > 0)  # NumPy is faster here than torch
        unmatched = {i: track for i, track in enumerate(predicted.tracks) if track not in updated.values()}
        coarse_surfaces = predicted.coarse_masks[list(unmatched)] & pack_masks(has_depth, self._stride)
        covered = self._covered(list(unmatched.values()), coarse_surfaces, detected, updated)
        for (i, track), coarse_surface, is_covered in zip(unmatched.items(), coarse_surfaces, covered, strict=True):
            if not track.may_move:
                track.drop_masks()
                resting.append(track)
                continue
            vacated = predicted.silhouettes[i].count_vacated(depth)
            if vacated > _MIN_VACATED_FRACTION * len(track.newest.cloud):
                track.add_vacated_time(stamp, min(stamp - self.last_stamp, _MAX_OBSERVED_TIME))
            if stamp - track.newest.stamp > self._config.max_missed_time or is_covered:
                lost.append(track)
                continue
            mask = predict_mask(track, predicted.silhouettes[i], depth, self._clouds.max_depth)
            is_recent = stamp - track.newest.stamp <= _MAX_SHOWN_TIME + STAMP_TOLERANCE
            is_shown = bool(predicted.visible[i]) and track.is_confirmed and is_recent
            masks = mask, mask & has_depth, predicted.coarse_masks[i], coarse_surface
            track.set_masks(*masks, missed=True, is_shown=is_shown)
            missed.append(track)
        self._update_tracks_without_masks(stamp, resting, lost)
        return missed

    def _update_tracks_without_masks(self, stamp: float, resting: Sequence[Track], lost: Sequence[Track]) -> None:
        """Store resting tracks, or lose them if they were missed for too long; remove lost tracks after some time."""
        longest = self._config.max_missed_time
        self.resting = [track for track in resting if stamp - track.newest.stamp <= longest]
        lost = [*lost, *(track for track in resting if stamp - track.newest.stamp > longest)]
        for track in lost:
            track.drop_masks()
            track.drop_old_detections()
        max_age = longest + self._config.max_lost_time
        candidates = [*self.lost, *(track for track in lost if track.is_confirmed)]
        self.lost = [track for track in candidates if stamp - track.newest.stamp <= max_age]

    def _covered(
        self,
        tracks: Sequence[Track],
        coarse_surfaces: Tensor,
        detected: DetectedInstances,
        updated: Mapping[int, Track],
    ) -> list[bool]:
        """Check for each track whether its predicted mask shows the surface of a detected track of the same class.

        The surface of the other track is given by its cloud, which is that of one person; a network sometimes draws one
        mask over two people.

        Args:
            tracks: T tracks.
            coarse_surfaces: Their predicted coarse masks where there is depth, packed, shape (T, B).
            detected: Instances of the frame.
            updated: Tracks that were detected, by the index of the instance.
        """
        with_centroid = [i for i, track in updated.items() if track.newest.has_centroid]
        if not with_centroid or not tracks:
            return [False] * len(tracks)
        common = count_common_pixels(coarse_surfaces, detected.coarse_surfaces[with_centroid])
        is_over = common > _MIN_COVERED_FRACTION * count_pixels(coarse_surfaces)[:, None]
        of_track, of_other = (
            torch.tensor([each.label for each in some]) for some in (tracks, [updated[i] for i in with_centroid])
        )
        covered: list[bool] = (is_over & (of_track[:, None] == of_other)).any(dim=1).tolist()
        return covered


def _assign(log_ratio: Tensor, rows: Tensor, columns: Tensor) -> list[tuple[int, int]]:
    """Assign columns to rows by their log-likelihood ratios; return the pairs of indices."""
    if not (rows.any() and columns.any()):
        return []
    matched = match_instances(log_ratio[None], rows[None], columns[None])[0]
    return [(i, j) for j, i in enumerate(matched.tolist()) if i >= 0]
