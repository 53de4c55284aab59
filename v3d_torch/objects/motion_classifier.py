"""Motion classification of the objects of a frame (paper, Sec. III-C, III-D)."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from v3d_torch.config import ObjectsConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.feature_support import FeatureSupport
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.objects.instance_tracker import InstanceTracker
from v3d_torch.objects.mask_propagation import propagate_instances
from v3d_torch.objects.mask_refiner import MaskRefiner, RefinedMask
from v3d_torch.objects.motion_evidence import (
    DetectionPairs,
    MotionEvidence,
    chamfer_evidence,
    detection_pairs,
    free_space_evidence,
    hough_vote_evidence,
)
from v3d_torch.objects.motion_state import decide_motion_state, is_held_dynamic
from v3d_torch.objects.result_masks import result_masks
from v3d_torch.objects.static_mask import static_masks
from v3d_torch.objects.static_surfaces import StaticSurfaces
from v3d_torch.objects.surface_centroids import SurfaceCentroids
from v3d_torch.objects.track import Track
from v3d_torch.runtime.stateful import StatefulComponent
from v3d_torch.segmentation.coco import LIVING, PERSON
from v3d_torch.types import Instances


class MotionClassifier(StatefulComponent):
    """Object stage of a frame: ids, motion states and the static mask.

    Args:
        config: Configuration of the object stage.
        camera: Camera of all frames.
    """

    _STATE = ("_tracker", "_static_surfaces")

    def __init__(self, config: ObjectsConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self._surface_centroids = SurfaceCentroids(config.clouds, camera)
        self._tracker = InstanceTracker(config.tracker, camera, config.clouds)
        self._static_surfaces = StaticSurfaces(config.free_space, camera)

    def __call__(
        self,
        instances: Instances,
        clouds: InstanceClouds,
        view: DepthView,
        appeared_pixels: AppearedPixels,
        feature_support: FeatureSupport,
        appearance: Tensor | None = None,
    ) -> FrameObjects:
        """Track and classify the objects of a frame, and update the tracks with the result.

        Args:
            instances: Instances of the frame.
            clouds: Clouds of the instances, camera frame.
            view: Depth of the frame, with the pose from frame-to-frame motion.
            appeared_pixels: Pixels of the frame that appeared, see `FreeSpaceCheck`.
            feature_support: Features of the frame and their agreement with the camera motion.
            appearance: Colour histograms of the instances, float32, shape :math:`(N, D)`; None if unknown.

        Returns:
            Objects with their motion states, and the static mask.
        """
        stamp, previous_stamp = view.stamp, self._tracker.last_stamp
        # Ids; missed objects are predicted (Sec. II, III-C).
        if not view.is_motion_measured:
            self._tracker.start_guessed_world(stamp)
        tracks = self._tracker(stamp, instances, clouds, view.depth, invert(view.T_dw), appearance)
        evidence = self._collect_evidence(tracks, previous_stamp, view, appeared_pixels, feature_support)

        # Motion states, with memory over frames.
        fractions, config = evidence.free_space.appeared_fractions, self._config.static_mask
        motion_states = {track: decide_motion_state(track, fractions[track], stamp, config) for track in tracks}
        for track, motion_state in motion_states.items():
            if motion_state is MotionState.STATIC:
                track.motion.mark_at_rest()

        # Masks, refined by depth, and the positions that they show.
        excluded = [track for track in tracks if not self._is_usable_for_camera(motion_states[track])]
        refined = self._refine_masks(excluded, tracks, view, appeared_pixels)
        size = view.missing.shape
        masks = static_masks([refined[track] for track in excluded], list(refined.values()), size, config)
        in_result = result_masks(tracks, refined, view.missing)
        self._record_visible_states(dict(zip(tracks, in_result, strict=True)), refined, view)

        objects = [
            TrackedObject(
                id=track.id,
                label=track.label,
                mask=mask,
                votes=evidence.vote.votes.get(track, 0),
                chamfer=evidence.chamfer.distances.get(track, torch.nan),
                motion_state=motion_states[track],
                missed=track.missed,
                **_world_attributes(track, stamp),
            )
            for track, mask in zip(tracks, in_result, strict=True)
        ]
        return FrameObjects(objects, masks.static_mask, masks.map_mask, evidence.vote.vote_pairs)

    def move_to_map(self, T_new_old: Tensor, *, all_tracks: bool = False) -> None:
        """Transform what was detected in a guessed world frame into that of the map, see `InstanceTracker.move_to_map`.

        Args:
            T_new_old: Transform from the guessed world frame to that of the map, float64, shape :math:`(4, 4)`.
            all_tracks: True to transform all detections, because they were made in another part of the map.
        """
        self._tracker.move_to_map(T_new_old, all_tracks=all_tracks)

    def add_view(self, view: DepthView, T_dw: Tensor, map_mask: Tensor) -> None:
        """Store the static surfaces of a frame, once its pose is known, see `StaticSurfaces.add_view`.

        Args:
            view: Depth of the frame.
            T_dw: Pose of the frame, world to camera, float64, shape :math:`(4, 4)`.
            map_mask: Pixels without people and moving objects, see `FrameObjects`, bool, shape :math:`(H, W)`.
        """
        self._static_surfaces.add_view(view, T_dw, map_mask)

    def drop_views(self) -> None:
        """Drop the stored surfaces: the pose of the next frames relative to them is a guess."""
        self._static_surfaces.drop_views()

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform the tracks and the stored views into the corrected world.

        Args:
            T_new_old: Transform from the old to the corrected world, float64, shape :math:`(4, 4)`.
        """
        self._tracker.apply_world_correction(T_new_old)
        self._static_surfaces.apply_world_correction(T_new_old)

    def correct_result(self, objects: FrameObjects) -> FrameObjects:
        """Return the objects of the last frame in the world frame to which the tracker was corrected since then.

        Args:
            objects: Result of the last call. Objects that the tracker does not have are left as they are.
        """
        # A correction replaces the clouds of the tracks; in most frames there is none. Missed objects have copies.
        clouds = {each.id: each.cloud for each in objects.objects}
        shown = [track for track in self._tracker.tracks if track.id in clouds]
        moved = [track for track in shown if track.newest.cloud is not clouds[track.id]]
        corrected = {track.id: _world_attributes(track, self._tracker.last_stamp) for track in moved}
        return replace(objects, objects=[replace(each, **corrected.get(each.id, {})) for each in objects.objects])

    def propagate_instances(self, view: DepthView) -> Instances:
        """Propagate the masks of the previous frame to a frame without segmentation; see `mask_propagation`.

        Args:
            view: Depth and pose of the frame.
        """
        return propagate_instances(self._tracker.tracks, view, self._camera, self._config.clouds)

    def _collect_evidence(
        self,
        tracks: list[Track],
        previous_stamp: float,
        view: DepthView,
        appeared_pixels: AppearedPixels,
        feature_support: FeatureSupport,
    ) -> MotionEvidence:
        """Collect the evidence of motion in a frame, and record it in the tracks.

        Args:
            tracks: Tracks of the frame, detected or missed.
            previous_stamp: Timestamp of the previous frame, seconds.
            view: Depth of the frame, with the pose from frame-to-frame motion.
            appeared_pixels: Pixels of the frame that appeared.
            feature_support: Features of the frame and their agreement with the camera motion.
        """
        config, stamp = self._config, view.stamp
        detected = [track for track in tracks if not track.missed]
        time_spans = (*config.voting.time_spans, config.chamfer.time_span)
        pairs = detection_pairs(detected, time_spans, self._tracker.comparable_since)

        # Independent evidence, not in the paper: free space. An object of which most appeared needs no votes: a new one
        # has no earlier distance to compare, and of a known one this shows the motion directly.
        free_space = free_space_evidence(tracks, pairs, view, appeared_pixels, config.free_space, self._camera)
        appeared = {track for track in detected if free_space.has_mostly_appeared(track)}

        # Spatial-reasoned Hough voting (Sec. III-C, Alg. 1).
        vote = hough_vote_evidence(pairs, free_space, previous_stamp, config.voting)

        # Independent evidence, not in the paper: features, which show slow motions earlier. Only cloud pixels count,
        # because a mask can contain other objects: the mask of a table contains the arms of people who sit at it.
        on_objects = feature_support.on_objects([track.cloud_pixels for track in tracks])
        # The camera motion is measured relative to the object with most features, such as a table that fills the image.
        with_most_inliers = self._rigid_with_most_inliers(tracks, feature_support.have_most_inliers(on_objects))
        self._add_shifts(tracks, with_most_inliers, feature_support, on_objects, view)
        shifted = {track for track in tracks if track.motion.last_shifted == stamp}
        for track in (appeared | vote.dynamic | shifted) - with_most_inliers:
            track.motion.mark_dynamic(stamp)
        for track, is_supported in zip(tracks, feature_support.supports(on_objects).tolist(), strict=True):
            track.motion.mark_supported(stamp, is_supported)

        # Intra-object motion by Chamfer distance (Sec. III-D) of the living objects that the vote leaves as static.
        candidates = self._deformation_candidates(pairs[config.chamfer.time_span], stamp)
        chamfer = chamfer_evidence(candidates, free_space, config.chamfer)
        for track in chamfer.deforming:
            track.motion.mark_deforming(stamp)
        return MotionEvidence(free_space, vote, chamfer)

    def _refine_masks(
        self, excluded: Sequence[Track], tracks: Sequence[Track], view: DepthView, appeared_pixels: AppearedPixels
    ) -> dict[Track, RefinedMask]:
        """Return the refined masks of the excluded objects and of all people."""
        people = [track for track in tracks if track.label == PERSON]
        refinable = list(dict.fromkeys([*excluded, *people]))
        refiner = MaskRefiner(refinable, view, appeared_pixels, self._static_surfaces, self._config, self._camera)
        return {track: refiner.refine(track) for track in refinable}

    def _record_visible_states(self, masks: Mapping[Track, Tensor], refined: Container[Track], view: DepthView) -> None:
        """Record the states of the detected objects, with the positions that refined masks show."""
        detected = [track for track in masks if not track.missed]
        measured = [track for track in detected if track in refined]
        positions = self._surface_centroids(view, [masks[track] for track in measured])
        position = dict(zip(measured, positions, strict=True))
        for track in detected:
            track.record_visible_state(position.get(track))

    def _deformation_candidates(self, pairs: DetectionPairs, stamp: float) -> DetectionPairs:
        """Return the pairs of living objects that are not dynamic: Chamfer distances refine the vote (Sec. I)."""
        if not self._config.chamfer.enabled:
            return {}
        return {
            track: pair
            for track, pair in pairs.items()
            if track.label in LIVING and not is_held_dynamic(track, stamp, self._config.static_mask)
        }

    def _add_shifts(
        self,
        tracks: Sequence[Track],
        reference: Container[Track],
        feature_support: FeatureSupport,
        on_objects: Tensor,
        view: DepthView,
    ) -> None:
        """Add to each object how far its features have moved against the camera motion.

        Args:
            tracks: Tracks of the frame.
            reference: Tracks relative to which the camera motion is measured; nothing is added to them.
            feature_support: Features of the frame.
            on_objects: Features of each object, see `FeatureSupport.on_objects`.
            view: Depth of the frame.
        """
        config = self._config.feature_shift
        if not config.enabled:
            return
        for track, shift in zip(tracks, feature_support.shifts(on_objects, view.missing.shape), strict=True):
            if track not in reference:
                track.motion.add_shift(view.stamp, shift, config.time_span)

    def _rigid_with_most_inliers(self, tracks: Sequence[Track], have_most_inliers: Tensor) -> set[Track]:
        """Return the rigid objects that have most of the inliers; people can have most of them on parts at rest."""
        flags = zip(tracks, have_most_inliers.tolist(), strict=True)
        return {track for track, has_most in flags if has_most and track.is_rigid}

    def _is_usable_for_camera(self, motion_state: MotionState) -> bool:
        """Check whether camera tracking can use the pixels of an object with this motion state."""
        deforming = motion_state is MotionState.DEFORMING and self._config.chamfer.keep_deforming_features
        return deforming or motion_state is MotionState.STATIC


def _world_attributes(track: Track, stamp: float) -> dict[str, Any]:
    """Return the attributes of a `TrackedObject` in the world frame."""
    cloud = track.newest.cloud
    return {
        "state": track.predict_visible_state(stamp),
        "history": tuple(track.history),
        "cloud": cloud + track.motion_to(track.predict_state(stamp)).to(cloud.dtype) if track.missed else cloud,
    }
