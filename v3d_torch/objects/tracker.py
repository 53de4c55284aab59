"""Ids of objects over frames by optimal assignment; objects that the network misses are predicted (paper, Sec. II)."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import IdentityConfig
from v3d_torch.lie import invert
from v3d_torch.objects.background import DepthView
from v3d_torch.objects.lift import ObjectClouds
from v3d_torch.objects.track import Sighting, Track
from v3d_torch.types import Instances


class InstanceTracker:
    """Gives each instance the id of the object that it shows.

    An instance continues the track of its class whose predicted centroid is nearest and whose mask it overlaps, in the
    assignment that is best for all together; no appearance takes part.

    Args:
        config: gates and times.
        camera: projects objects that the network missed.
        voxel_size: spacing of the clouds, metres.
    """

    _STRIDE = 4  # masks are compared on every 4th pixel: an overlap needs no more
    _FORBIDDEN = 2.0  # cost of a pair that cannot be: the most of one that can, or ids would move along to fill gaps
    _DEPTH_GATE = 0.3  # metres: half the depth of a person; a predicted mask keeps only pixels that near

    def __init__(self, config: IdentityConfig, camera: PinholeCamera, voxel_size: float) -> None:
        self._config = config
        self._camera = camera
        self._voxel_size = voxel_size
        self._next_id = 1
        self.tracks: list[Track] = []

    def __call__(
        self, stamp: float, instances: Instances, clouds: ObjectClouds, depth: Tensor, T_wc: Tensor
    ) -> list[Track]:
        """Update the tracks with a frame.

        Args:
            stamp: seconds.
            instances: of the frame, best first.
            clouds: of the instances, camera frame.
            depth: metres, shape :math:`(1, H, W)`.
            T_wc: camera to world, as far as it is known now.

        Returns:
            Tracks in view or missed for less than the longest gap, by id.
        """
        view = DepthView(depth, invert(T_wc))
        sightings = [self._sight(stamp, clouds, i, T_wc, view) for i in range(len(instances))]
        owner = self._assign(stamp, instances, sightings)
        continued = set()
        for i, sighting in enumerate(sightings):
            track = owner.get(i)
            if track is None:
                track = Track(self._next_id, instances.masks[i], stamp, [sighting])
                self._next_id += 1
                self.tracks.append(track)
            else:
                track.extend(sighting, self._config.velocity_gain, self._config.history)
            track.mask, track.missed = instances.masks[i], False
            track.labels[int(instances.labels[i])] += 1
            continued.add(track.id)
        self.tracks = [t for t in self.tracks if stamp - t.newest.stamp <= self._config.max_gap]
        for track in self.tracks:
            if track.id not in continued:
                track.missed = True
                track.mask = self._predict_mask(track, stamp, depth, T_wc)
        return list(self.tracks)

    def move_world(self, T_new_old: Tensor) -> None:
        """Carry the tracks along when the map is corrected under them.

        Args:
            T_new_old: corrected world from old world, float64, shape :math:`(4, 4)`.
        """
        R, t = T_new_old[:3, :3], T_new_old[:3, 3]
        for track in self.tracks:
            track.velocity = R @ track.velocity
            track.sightings = [
                Sighting(
                    s.stamp,
                    R @ s.centroid + t,
                    s.cloud @ R.T.to(s.cloud) + t.to(s.cloud),
                    DepthView(s.view.depth, s.view.T_cw @ invert(T_new_old)),
                )
                for s in track.sightings
            ]

    def _sight(self, stamp: float, clouds: ObjectClouds, i: int, T_wc: Tensor, view: DepthView) -> Sighting:
        cloud = clouds.points[i, clouds.valid[i]]
        R, t = T_wc[:3, :3], T_wc[:3, 3]
        return Sighting(stamp, R @ clouds.centroid[i].to(R) + t, cloud @ R.T.to(cloud) + t.to(cloud), view)

    def _assign(self, stamp: float, instances: Instances, sightings: list[Sighting]) -> dict[int, Track]:
        """Track of each instance that continues one."""
        if not self.tracks or not sightings:
            return {}
        predicted = torch.stack([track.predict(stamp) for track in self.tracks])
        seen = torch.stack([sighting.centroid for sighting in sightings])
        distance = torch.cdist(predicted, seen)
        overlap = _overlap(
            torch.stack([track.mask[:: self._STRIDE, :: self._STRIDE] for track in self.tracks]),
            instances.masks[:, :: self._STRIDE, :: self._STRIDE],
        )
        elapsed = torch.tensor([stamp - track.newest.stamp for track in self.tracks], dtype=torch.float64)
        gate = (self._config.max_jump + self._config.max_speed * elapsed)[:, None]
        overlaps = overlap >= self._config.least_overlap
        # Without a centroid on either side the masks alone decide.
        near = torch.where(torch.isfinite(distance), distance <= gate, overlaps)
        labels = torch.tensor([track.label for track in self.tracks])
        possible = near & ((labels[:, None] == instances.labels[None, :]) | overlaps)
        cost = torch.where(torch.isfinite(distance), distance / gate, 1.0) + (1 - overlap)
        rows, columns = linear_sum_assignment(torch.where(possible, cost, self._FORBIDDEN).numpy())
        return {
            int(column): self.tracks[row] for row, column in zip(rows, columns, strict=True) if possible[row, column]
        }

    def _predict_mask(self, track: Track, stamp: float, depth: Tensor, T_wc: Tensor) -> Tensor:
        """Pixels where a missed object should be: its last cloud, moved on, where the depth agrees."""
        mask = torch.zeros_like(track.mask)
        T_cw = invert(T_wc)
        moved = track.newest.cloud.to(torch.float64) + track.velocity * (stamp - track.newest.stamp)
        points = moved @ T_cw[:3, :3].T + T_cw[:3, 3]
        points = points[points[:, 2] > 0.1]
        if points.shape[0] == 0:
            return mask
        u, v = self._camera.distort(self._camera.project(points)).round().to(torch.int64).unbind(dim=1)
        inside = (u >= 0) & (v >= 0) & (u < mask.shape[1]) & (v < mask.shape[0])
        mask[v[inside], u[inside]] = True
        nearest, farthest = points[:, 2].min(), points[:, 2].max()
        # Points are a voxel apart: growing each by that much on the image closes the gaps.
        reach = int((self._voxel_size * self._camera.fx / points[:, 2].median()).ceil().clamp(1, 32))
        grown = cv2.dilate(mask.to(torch.uint8).numpy(), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        mask = torch.from_numpy(grown > 0)
        near = (depth[0] > nearest - self._DEPTH_GATE) & (depth[0] < farthest + self._DEPTH_GATE)
        return mask & (near | (depth[0] <= 0))


def _overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of every mask of ``a`` with every one of ``b``, float64, shape :math:`(A, B)`."""
    a, b = a.flatten(1).to(torch.float32), b.flatten(1).to(torch.float32)
    both = a @ b.T
    either = a.sum(dim=1)[:, None] + b.sum(dim=1)[None, :] - both
    return (both / either.clamp(min=1)).to(torch.float64)
