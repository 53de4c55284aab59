"""Multi-object tracking: object ids by optimal assignment, and prediction of missed objects (paper, Sec. II)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.packed_masks import count_common_pixels, count_pixels, pack_masks
from v3d_torch.geometry.se3 import invert
from v3d_torch.objects.assignment import match_instances
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.objects.silhouette import Silhouette, silhouettes
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.types import Instances

_COARSE_COLUMNS = 160
"""Number of columns of the coarse masks that are compared: the resolution of the network's own masks."""

_MIN_VISIBLE_FRACTION = 0.5
"""An object is visible at its predicted position if the depth agrees with more than this fraction of its points."""

_MAX_BESIDE_OVERLAP = 0.1
"""An instance lies beside a predicted mask if their intersection is less than this fraction of the smaller area."""

_DEPTH_TOLERANCE = 0.2
"""Tolerance of the depth of a predicted object, metres: arms and legs swing by this much."""


class InstanceTracker(torch.nn.Module):
    """Assignment of object ids to the instances of each frame.

    An instance continues the track of its class with the nearest predicted centroid, or the track whose last or
    predicted mask it overlaps, in the assignment with the smallest total cost. Appearance is not used. The state
    (tracks and next id) is part of ``state_dict()``.

    Args:
        config: Gates and times.
        camera: Camera of all frames.
        voxel_size: Spacing of the points of the clouds, metres.
    """

    def __init__(self, config: TrackerConfig, camera: PinholeCamera, voxel_size: float) -> None:
        super().__init__()
        self._config = config
        self._camera = camera
        self._voxel_size = voxel_size
        self._stride = max(1, camera.width // _COARSE_COLUMNS)
        self._next_id = 1
        self.tracks: list[Track] = []

    def get_extra_state(self) -> dict[str, Any]:
        """Return the tracks and the next id, for ``state_dict()``."""
        return {"tracks": list(self.tracks), "next_id": self._next_id}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Replace the tracks and the next id, for ``load_state_dict()``.

        Args:
            state: Result of `get_extra_state`.
        """
        self.tracks = list(state["tracks"])
        self._next_id = state["next_id"]

    def forward(
        self, stamp: float, instances: Instances, clouds: InstanceClouds, depth: Tensor, T_wc: Tensor
    ) -> list[Track]:
        """Update the tracks with a frame.

        Args:
            stamp: Timestamp, seconds.
            instances: Instances of the frame, by descending score.
            clouds: Clouds of the instances, camera frame.
            depth: Depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.
            T_wc: Estimated camera-to-world pose, float64, shape :math:`(4, 4)`.

        Returns:
            Tracks that were detected, or missed for at most the maximum time, sorted by id.
        """
        step = self._stride
        detections = [self._detection(stamp, clouds, i, T_wc) for i in range(len(instances))]
        coarse_masks = pack_masks(instances.masks, step)

        # Predict each track, and check whether the object is visible there.
        predicted = self._predict_silhouettes(stamp, T_wc)
        coarse_depth = depth[:, ::step, ::step].contiguous()
        predicted_masks = [self._predict_mask(silhouette, coarse_depth, step) for silhouette in predicted.values()]
        predicted_coarse = dict(zip(predicted, map(pack_masks, predicted_masks), strict=True))
        visible = torch.tensor(
            [s.visible_fraction(depth, _DEPTH_TOLERANCE) > _MIN_VISIBLE_FRACTION for s in predicted.values()]
        )

        # Update matched tracks, and start a track for each instance without a match.
        matches = self._match(stamp, instances, coarse_masks, detections, predicted_coarse, visible)
        detected = set()
        for i, detection in enumerate(detections):
            masks = instances.masks[i], clouds.cloud_pixels[i], coarse_masks[i]
            track = matches.get(i) or self._start_track(stamp, masks)
            track.add_detection(detection)
            track.set_masks(*masks, missed=False)
            track.update_label(int(instances.labels[i]), float(instances.scores[i]))
            detected.add(track.id)

        # Predict the masks of missed tracks, and remove those that were missed for too long.
        self.tracks = [t for t in self.tracks if stamp - t.newest.stamp <= self._config.max_missed_time]
        has_depth = torch.from_numpy(depth[0].numpy() > 0)  # NumPy is faster here than torch
        for track in self.tracks:
            if track.id not in detected:
                mask = self._predict_mask(predicted[track], depth)
                track.set_masks(mask, mask & has_depth, predicted_coarse[track], missed=True)
        self._remove_duplicates(pack_masks(has_depth, step))
        return list(self.tracks)

    def apply_world_correction(self, T_new_old: Tensor) -> None:
        """Transform all tracks into the corrected world.

        Args:
            T_new_old: Transform from the old to the corrected world, float64, shape :math:`(4, 4)`.
        """
        for track in self.tracks:
            track.apply_world_correction(T_new_old)

    def _detection(self, stamp: float, clouds: InstanceClouds, i: int, T_wc: Tensor) -> Detection3D:
        """Return the detection of the i-th instance in the world frame."""
        cloud = clouds.points[i, clouds.valid[i]]
        R, t = T_wc[:3, :3], T_wc[:3, 3]
        return Detection3D(stamp, R @ clouds.centroid[i].to(R) + t, cloud @ R.T.to(cloud) + t.to(cloud))

    def _start_track(self, stamp: float, masks: tuple[Tensor, Tensor, Tensor]) -> Track:
        """Add a track with the next id and return it."""
        track = Track(self._next_id, stamp, self._config, *masks)
        self._next_id += 1
        self.tracks.append(track)
        return track

    def _predict_silhouettes(self, stamp: float, T_wc: Tensor) -> dict[Track, Silhouette]:
        """Project the predicted cloud of each track into the image."""
        T_cw = invert(T_wc)
        clouds = [track.predict_cloud(stamp) @ T_cw[:3, :3].T + T_cw[:3, 3] for track in self.tracks]
        return dict(zip(self.tracks, silhouettes(clouds, self._camera, self._voxel_size), strict=True))

    def _predict_mask(self, silhouette: Silhouette, depth: Tensor, step: int = 1) -> Tensor:
        """Return the pixels of a silhouette whose depth agrees or is missing, for every n-th pixel; bool, (h, w)."""
        return silhouette.mask(depth, 0, _DEPTH_TOLERANCE, step=step, include_missing=True)

    def _match(
        self,
        stamp: float,
        instances: Instances,
        masks: Tensor,
        detections: list[Detection3D],
        predicted_coarse: dict[Track, Tensor],
        visible: Tensor,
    ) -> dict[int, Track]:
        """Match instances to tracks.

        Args:
            stamp: Timestamp, seconds.
            instances: N instances of the frame.
            masks: Coarse masks of the instances, packed, shape (N, B).
            detections: Detections of the instances.
            predicted_coarse: Predicted coarse mask of each of the T tracks, packed, shape (B,).
            visible: Tracks that are visible at their predicted position, bool, shape (T,).

        Returns:
            Track of each instance that continues one, by the index of the instance.
        """
        if not self.tracks or not detections:
            return {}
        predicted = torch.stack([track.predict_centroid(stamp) for track in self.tracks])
        observed = torch.stack([detection.centroid for detection in detections])
        # The last mask is exact if little moves. The predicted mask follows fast walkers and a turning camera.
        last_masks = torch.stack([track.coarse_mask for track in self.tracks])
        predicted_masks = torch.stack(list(predicted_coarse.values()))
        last_intersection, intersection = (count_common_pixels(each, masks) for each in (last_masks, predicted_masks))
        last_areas, predicted_areas = (count_pixels(each)[:, None] for each in (last_masks, predicted_masks))
        areas = count_pixels(masks)
        overlap = torch.maximum(
            _intersection_over_union(last_intersection, last_areas, areas),
            _intersection_over_union(intersection, predicted_areas, areas),
        )
        covered = intersection > self._config.min_overlap * predicted_areas
        # A detection beside an object that is visible at its predicted position is another object.
        beside = intersection < _MAX_BESIDE_OVERLAP * torch.minimum(predicted_areas, areas)
        elapsed = torch.tensor([stamp - track.newest.stamp for track in self.tracks], dtype=torch.float64)
        gate = self._config.max_jump + self._config.max_speed * elapsed
        same_class = torch.tensor([track.label for track in self.tracks])[:, None] == instances.labels
        matched = match_instances(
            predicted[None],
            observed[None],
            overlap[None],
            same_class[None],
            gate[None],
            self._config.min_overlap,
            covered=covered[None],
            excluded=(visible[:, None] & beside)[None],
        )[0]
        return {i: self.tracks[track] for i, track in enumerate(matched.tolist()) if track >= 0}

    def _remove_duplicates(self, has_depth: Tensor) -> None:
        """Remove missed tracks whose predicted mask a detected track of the same class covers: they are one object.

        Args:
            has_depth: Coarse pixels with depth, packed, shape (B,).
        """
        missed = [track for track in self.tracks if track.missed]
        located = [track for track in self.tracks if not track.missed and track.newest.is_located]
        if not missed or not located:
            return
        masks = torch.stack([track.coarse_mask for track in missed]) & has_depth
        intersection = count_common_pixels(masks, torch.stack([track.coarse_mask for track in located]))
        same_class = torch.tensor([[track.label == other.label for other in located] for track in missed])
        covered = intersection > self._config.min_overlap * count_pixels(masks)[:, None]
        duplicate = (same_class & covered).any(dim=1)
        removed = {track for track, is_duplicate in zip(missed, duplicate.tolist(), strict=True) if is_duplicate}
        self.tracks = [track for track in self.tracks if track not in removed]


def _intersection_over_union(intersection: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the intersection over union from areas of intersections (A, B) and masks (A, 1) and (B,), float64."""
    return (intersection / (a + b - intersection).clamp(min=1)).to(torch.float64)
