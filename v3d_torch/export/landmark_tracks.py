"""Landmarks of a sparse map with the exported images that observe them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.types import Trajectory

_MAX_STAMP_DIFFERENCE = 1e-6
"""Largest difference between the timestamps of a keyframe and of its image, seconds: files have six decimals."""

_MAX_POSE_DIFFERENCE = 1e-6
"""Largest difference between the poses of a keyframe and of its image, per element."""

_MIN_OBSERVATIONS = 2
"""Number of images that observe a landmark."""


@dataclass(frozen=True)
class LandmarkTracks:
    """Landmarks with their observations.

    Attributes:
        points: Positions, world frame, metres, float64, shape :math:`(L, 3)`.
        image: Image of each observation, as an index, int64, shape :math:`(O,)`, sorted.
        landmark: Landmark of each observation, as a row of ``points``, int64, shape :math:`(O,)`.
        uv: Undistorted pixel of each observation, float64, shape :math:`(O, 2)`.
    """

    points: Tensor
    image: Tensor
    landmark: Tensor
    uv: Tensor

    def select(self, observations: Tensor) -> LandmarkTracks:
        """Keep some observations, except those of landmarks that fewer than two images would observe.

        The points keep their rows, also those without observations.

        Args:
            observations: True for observations to keep, bool, shape :math:`(O,)`.
        """
        counts = torch.bincount(self.landmark[observations], minlength=len(self.points))
        kept = observations & (counts >= _MIN_OBSERVATIONS)[self.landmark]
        return replace(self, image=self.image[kept], landmark=self.landmark[kept], uv=self.uv[kept])


def landmark_tracks(tables: MapTables, images: Trajectory) -> LandmarkTracks:
    """Select the landmarks that at least two images observe.

    Args:
        tables: Data of the map.
        images: Poses of the images. Keyframes with the time of an image but another pose come from another run and are
            ignored.
    """
    image_of_keyframe = _images_of_keyframes(tables, images)
    observations = tables.observations
    image, landmark = image_of_keyframe[observations["keyframe"]], observations["landmark"]
    usable = observations["valid"] & tables.landmarks["active"][landmark] & (image >= 0)
    counts = torch.bincount(landmark[usable], minlength=len(tables.landmarks))
    rows = torch.nonzero(usable & (counts >= _MIN_OBSERVATIONS)[landmark])[:, 0]
    rows = rows[torch.argsort(image[rows], stable=True)]
    kept = torch.nonzero(counts >= _MIN_OBSERVATIONS)[:, 0]
    return LandmarkTracks(
        points=tables.landmarks["point"][kept],
        image=image[rows],
        landmark=torch.searchsorted(kept, landmark[rows]),
        uv=observations["uv"][rows],
    )


def has_keyframes(tables: MapTables, keyframes: Trajectory) -> bool:
    """Check whether a map has all keyframes of a run at their times and poses, so that it is the map of this run.

    One equal keyframe is not enough: the first keyframe of most runs of a sequence is the origin of the world.

    Args:
        tables: Data of the map.
        keyframes: Poses of the keyframes at the end of the run.
    """
    found = _images_of_keyframes(tables, keyframes)
    return len(found[found >= 0].unique()) == len(keyframes)


def _images_of_keyframes(tables: MapTables, images: Trajectory) -> Tensor:
    """Index of the image of each keyframe, -1 for none, int64, shape (K,)."""
    keyframe_stamps = torch.tensor([each.stamp for each in tables.keyframes], dtype=torch.float64)
    if not len(images):
        return torch.full((len(keyframe_stamps),), -1)
    distances = (keyframe_stamps[:, None] - images.stamps).abs()
    nearest = distances.argmin(dim=1)
    T_identity = tables.T_cw @ images.T_wc[nearest]
    same_pose = (T_identity - torch.eye(4, dtype=torch.float64)).abs().amax(dim=(1, 2)) <= _MAX_POSE_DIFFERENCE
    same_time = distances.gather(1, nearest[:, None])[:, 0] <= _MAX_STAMP_DIFFERENCE
    return torch.where(same_time & same_pose, nearest, -1)
