"""Ids of objects over frames by optimal assignment; objects that the network misses are predicted (paper, Sec. II)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import IdentityConfig
from v3d_torch.lie import invert
from v3d_torch.objects.assignment import match_instances
from v3d_torch.objects.lift import ObjectClouds
from v3d_torch.objects.silhouette import silhouette
from v3d_torch.objects.track import Sighting, Track
from v3d_torch.types import Instances


class InstanceTracker(torch.nn.Module):
    """Gives each instance the id of the object that it shows.

    An instance continues the track of its class whose predicted centroid is nearest and whose mask it overlaps, as it
    was or where the motion has carried it, in the assignment that is best for all together; no appearance takes part.

    Args:
        config: gates and times.
        camera: projects objects to where they should be now.
        voxel_size: spacing of the clouds, metres.
    """

    _COLUMNS = 160  # masks are compared on about so many columns of pixels: those of the network's own masks
    _DEPTH_GATE = 0.2  # metres: arms and legs swing by that; a predicted mask keeps only pixels that near

    def __init__(self, config: IdentityConfig, camera: PinholeCamera, voxel_size: float) -> None:
        super().__init__()
        self._config = config
        self._camera = camera
        self._voxel_size = voxel_size
        self._stride = max(1, camera.width // self._COLUMNS)
        self._next_id = 1
        self.tracks: list[Track] = []

    def forward(
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
        sightings = [self._sight(stamp, clouds, i, T_wc) for i in range(len(instances))]
        # Where each should be by now: to be found there, and left out there if it is not found.
        moved = {track: self._predict_mask(track, stamp, depth, T_wc) for track in self.tracks}
        owner = self._assign(stamp, instances, sightings, moved)
        continued = set()
        for i, sighting in enumerate(sightings):
            track = owner.get(i)
            if track is None:
                track = Track(self._next_id, instances.masks[i], clouds.own[i], stamp, self._config)
                self._next_id += 1
                self.tracks.append(track)
            track.extend(sighting)
            track.mask, track.own, track.missed = instances.masks[i], clouds.own[i], False
            track.labels[int(instances.labels[i])] += 1
            track.score += float(instances.scores[i])
            continued.add(track.id)
        self.tracks = [t for t in self.tracks if stamp - t.newest.stamp <= self._config.max_gap]
        for track in self.tracks:
            if track.id not in continued:
                track.missed = True
                track.mask = moved[track]
                track.own = track.mask & (depth[0] > 0)
        self.tracks = [track for track in self.tracks if not (track.missed and self._is_found_again(track))]
        return list(self.tracks)

    def _is_found_again(self, missed: Track) -> bool:
        """Whether an object of its class was found where a missed one should be: the same, with another id."""
        least = self._config.least_overlap * int(missed.own.sum())
        others = (t for t in self.tracks if not t.missed and t.newest.located and t.label == missed.label)
        return any(int((missed.own & other.mask).sum()) > least for other in others)

    def move_world(self, T_new_old: Tensor) -> None:
        """Carry the tracks along when the map is corrected under them.

        Args:
            T_new_old: corrected world from old world, float64, shape :math:`(4, 4)`.
        """
        for track in self.tracks:
            track.move_world(T_new_old)

    def _sight(self, stamp: float, clouds: ObjectClouds, i: int, T_wc: Tensor) -> Sighting:
        cloud = clouds.points[i, clouds.valid[i]]
        R, t = T_wc[:3, :3], T_wc[:3, 3]
        return Sighting(stamp, R @ clouds.centroid[i].to(R) + t, cloud @ R.T.to(cloud) + t.to(cloud))

    def _assign(
        self, stamp: float, instances: Instances, sightings: list[Sighting], moved: dict[Track, Tensor]
    ) -> dict[int, Track]:
        """Track of each instance that continues one."""
        if not self.tracks or not sightings:
            return {}
        predicted = torch.stack([track.predict(stamp) for track in self.tracks])
        seen = torch.stack([sighting.centroid for sighting in sightings])
        masks = instances.masks[:, :: self._stride, :: self._stride]
        before = torch.stack([track.mask[:: self._stride, :: self._stride] for track in self.tracks])
        now = torch.stack([moved[track][:: self._stride, :: self._stride] for track in self.tracks])
        # A mask as it was is exact where little moves; moved on, it keeps up with fast walkers and a camera that turns.
        overlap = torch.maximum(_overlap(before, masks), _overlap(now, masks))
        elapsed = torch.tensor([stamp - track.newest.stamp for track in self.tracks], dtype=torch.float64)
        gate = self._config.max_jump + self._config.max_speed * elapsed
        alike = torch.tensor([track.label for track in self.tracks])[:, None] == instances.labels
        matched = match_instances(
            predicted[None], seen[None], overlap[None], alike[None], gate[None], self._config.least_overlap
        )[0]
        return {i: self.tracks[track] for i, track in enumerate(matched.tolist()) if track >= 0}

    def _predict_mask(self, track: Track, stamp: float, depth: Tensor, T_wc: Tensor) -> Tensor:
        """Pixels where an object should be: its last cloud, moved on, where the depth agrees."""
        T_cw = invert(T_wc)
        cloud = track.cloud_at(stamp) @ T_cw[:3, :3].T + T_cw[:3, 3]
        near, explained = silhouette(cloud, depth, self._camera, self._voxel_size, 0, self._DEPTH_GATE)
        return near & (explained | (depth[0] <= 0))


def _overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union of every mask of ``a`` with every one of ``b``, float64, shape :math:`(A, B)`."""
    a, b = a.flatten(1).to(torch.float32), b.flatten(1).to(torch.float32)
    both = a @ b.T
    either = a.sum(dim=1)[:, None] + b.sum(dim=1)[None, :] - both
    return (both / either.clamp(min=1)).to(torch.float64)
