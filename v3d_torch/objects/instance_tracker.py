"""Ids of objects over frames by optimal assignment; objects that the network misses are predicted (paper, Sec. II)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.config import TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.objects.assignment import match_instances
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.objects.silhouette import Silhouette, silhouettes
from v3d_torch.objects.track import Detection3D, Track
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
    _THERE = 0.5  # an object is where it was predicted if so many of its points are seen there
    _BESIDE = 0.1  # and what covers less than this of it, and is covered by less, is another one
    _DEPTH_GATE = 0.2  # metres: arms and legs swing by that; a predicted mask keeps only pixels that near

    def __init__(self, config: TrackerConfig, camera: PinholeCamera, voxel_size: float) -> None:
        super().__init__()
        self._config = config
        self._camera = camera
        self._voxel_size = voxel_size
        self._stride = max(1, camera.width // self._COLUMNS)
        self._next_id = 1
        self.tracks: list[Track] = []

    def forward(
        self, stamp: float, instances: Instances, clouds: InstanceClouds, depth: Tensor, T_wc: Tensor
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
        expected = self._expect(stamp, T_wc)
        places = [self._where(silhouette, depth, self._stride) for silhouette in expected.values()]
        now = dict(zip(expected, self._coarse(torch.stack(places)) if places else (), strict=True))
        there = [silhouette.visible_fraction(depth, self._DEPTH_GATE) > self._THERE for silhouette in expected.values()]
        masks = self._coarse(instances.masks[:, :: self._stride, :: self._stride])
        owner = self._assign(stamp, instances, masks, sightings, now, torch.tensor(there))
        continued = set()
        for i, sighting in enumerate(sightings):
            track = owner.get(i)
            if track is None:
                track = Track(self._next_id, instances.masks[i], clouds.cloud_pixels[i], masks[i], stamp, self._config)
                self._next_id += 1
                self.tracks.append(track)
            track.add_detection(sighting)
            track.mask, track.cloud_pixels, track.coarse_mask, track.missed = (
                instances.masks[i],
                clouds.cloud_pixels[i],
                masks[i],
                False,
            )
            track.update_label(int(instances.labels[i]), float(instances.scores[i]))
            continued.add(track.id)
        self.tracks = [t for t in self.tracks if stamp - t.newest.stamp <= self._config.max_missed_time]
        measured = torch.from_numpy(depth[0].numpy() > 0)  # in a sixth of torch's time
        for track in self.tracks:
            if track.id not in continued:
                track.missed = True
                track.mask, track.coarse_mask = self._where(expected[track], depth), now[track]
                track.cloud_pixels = track.mask & measured
        self._drop_found_again(self._coarse(measured[:: self._stride, :: self._stride]))
        return list(self.tracks)

    def _drop_found_again(self, measured: Tensor) -> None:
        """Drop missed objects where one of their class was found where they should be: the same, with another id.

        ``measured`` tells on which of the coarse pixels there is depth.
        """
        missed = [track for track in self.tracks if track.missed]
        found = [track for track in self.tracks if not track.missed and track.newest.is_located]
        if not missed or not found:
            return
        own = torch.stack([track.coarse_mask for track in missed]) * measured
        both = own @ torch.stack([track.coarse_mask for track in found]).T
        alike = torch.tensor([[track.label == other.label for other in found] for track in missed])
        again = (alike & (both > self._config.min_overlap * own.sum(dim=1, keepdim=True))).any(dim=1)
        dropped = {track for track, is_again in zip(missed, again.tolist(), strict=True) if is_again}
        self.tracks = [track for track in self.tracks if track not in dropped]

    @staticmethod
    def _coarse(mask: Tensor) -> Tensor:
        """Every n-th pixel of masks as rows of numbers, bool :math:`(..., h, w)` to float32 :math:`(..., P)`."""
        return mask.flatten(-2).to(torch.float32)

    def move_world(self, T_new_old: Tensor) -> None:
        """Carry the tracks along when the map is corrected under them.

        Args:
            T_new_old: corrected world from old world, float64, shape :math:`(4, 4)`.
        """
        for track in self.tracks:
            track.move_world(T_new_old)

    def _sight(self, stamp: float, clouds: InstanceClouds, i: int, T_wc: Tensor) -> Detection3D:
        cloud = clouds.points[i, clouds.valid[i]]
        R, t = T_wc[:3, :3], T_wc[:3, 3]
        return Detection3D(stamp, R @ clouds.centroid[i].to(R) + t, cloud @ R.T.to(cloud) + t.to(cloud))

    def _assign(
        self,
        stamp: float,
        instances: Instances,
        masks: Tensor,
        sightings: list[Detection3D],
        now: dict[Track, Tensor],
        there: Tensor,
    ) -> dict[int, Track]:
        """Track of each instance that continues one.

        ``masks`` are those of the instances, coarse, ``now`` is where each track should be by now, and ``there`` tells
        whether it is seen to be there.
        """
        if not self.tracks or not sightings:
            return {}
        predicted = torch.stack([track.predict(stamp) for track in self.tracks])
        seen = torch.stack([sighting.centroid for sighting in sightings])
        # A mask as it was is exact where little moves; moved on, it keeps up with fast walkers and a camera that turns.
        before, moved = torch.stack([track.coarse_mask for track in self.tracks]), torch.stack(list(now.values()))
        both, areas, own = moved @ masks.T, moved.sum(dim=1)[:, None], masks.sum(dim=1)
        overlap = torch.maximum(_overlap(before @ masks.T, before.sum(dim=1)[:, None], own), _overlap(both, areas, own))
        covered = both > self._config.min_overlap * areas
        # A detection beside somebody who is seen to be where expected is somebody else, or nobody.
        elsewhere = there[:, None] & (both < self._BESIDE * torch.minimum(areas, own))
        elapsed = torch.tensor([stamp - track.newest.stamp for track in self.tracks], dtype=torch.float64)
        gate = self._config.max_jump + self._config.max_speed * elapsed
        alike = torch.tensor([track.label for track in self.tracks])[:, None] == instances.labels
        matched = match_instances(
            predicted[None],
            seen[None],
            overlap[None],
            alike[None],
            gate[None],
            self._config.min_overlap,
            covered=covered[None],
            elsewhere=elsewhere[None],
        )[0]
        return {i: self.tracks[track] for i, track in enumerate(matched.tolist()) if track >= 0}

    def _expect(self, stamp: float, T_wc: Tensor) -> dict[Track, Silhouette]:
        """The last cloud of each object, moved on to where it should be in the image."""
        T_cw = invert(T_wc)
        clouds = [track.cloud_at(stamp) @ T_cw[:3, :3].T + T_cw[:3, 3] for track in self.tracks]
        return dict(zip(self.tracks, silhouettes(clouds, self._camera, self._voxel_size), strict=True))

    def _where(self, expected: Silhouette, depth: Tensor, step: int = 1) -> Tensor:
        """Every n-th pixel of an object where the depth agrees or is missing, bool, :math:`(h, w)`."""
        return expected(depth[:, ::step, ::step], 0, self._DEPTH_GATE, step=step, or_missing=True)


def _overlap(both: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union by the areas of intersections (A, B) and masks (A, 1) and (B,), float64, (A, B)."""
    return (both / (a + b - both).clamp(min=1)).to(torch.float64)
