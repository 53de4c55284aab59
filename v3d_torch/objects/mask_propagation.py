"""Propagation of object masks to a frame without segmentation.

Segmentation of every second frame halves the largest cost of a frame. In the frame between, the track of an object
predicts its points, and the depth image gives its outline: the pixels near the predicted points that have the depth of
these points. Propagated masks are then used like network masks: centroids, votes and Chamfer distances come from the
depth of the frame and not from a prediction; only the ids are known before. An object without a centroid, for example
because it is too far away, has few or no points to project: it keeps its last mask where nothing is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.config import CloudConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.silhouette import DEPTH_TOLERANCE, Silhouette, silhouettes
from v3d_torch.objects.track import Track, predict_clouds
from v3d_torch.segmentation.coco import UNLABELLED
from v3d_torch.types import Instances


def propagate_instances(
    tracks: Sequence[Track], view: DepthView, camera: PinholeCamera, config: CloudConfig
) -> Instances:
    """Compute the masks of detected objects from the depth of the current frame.

    Unlabelled objects are left out, because they are detected in the depth of every frame.

    Args:
        tracks: Tracks after the previous frame.
        view: Depth and pose of the frame.
        camera: Camera of the frame.
        config: Spacing and maximum depth of the points of the tracks.

    Returns:
        Instances with the ids and classes of the tracks, score 0 and empty boxes.
    """
    detected = [track for track in tracks if not track.missed and track.label != UNLABELLED]
    states = [track.predict_state(view.stamp) for track in detected]
    projected = silhouettes(predict_clouds(detected, states, view.T_dw), camera, config.voxel_size)
    masks = {
        track: mask
        for track, each in zip(detected, projected, strict=True)
        # An object without a pixel has left the view or is hidden: it is missed.
        if (mask := predict_mask(track, each, view.depth, config.max_depth)).numpy().any()
    }
    if not masks:
        return Instances.empty(*view.depth.shape[-2:])
    labels, track_ids = torch.tensor([[track.label, track.id] for track in masks]).T
    return replace(Instances.from_masks(torch.stack([*masks.values()]), labels), track_ids=track_ids)


def predict_mask(track: Track, silhouette: Silhouette, depth: Tensor, max_depth: float, *, stride: int = 1) -> Tensor:
    """Return the pixels near the predicted points that have their depth.

    Without a centroid, the pixels of the last mask at which no points are measured belong to the object as well. Pixels
    with points do not: the centroid would be that of something beside or in front of the object.

    Args:
        track: Track of the object.
        silhouette: Projection of its predicted cloud.
        depth: Depth of every n-th pixel, metres, shape :math:`(1, h, w)`; 0 = no measurement.
        max_depth: Maximum depth of points, metres.
        stride: Step n between the pixels of ``depth``.

    Returns:
        Mask of every n-th pixel, bool, shape :math:`(h, w)`.
    """
    mask = silhouette.mask(depth, 0, DEPTH_TOLERANCE, stride=stride, include_missing=True)
    if track.newest.has_centroid:
        return mask
    z = depth[0].numpy()  # NumPy is faster here than torch
    has_points = (z > 0) & (z <= max_depth)
    return torch.from_numpy(mask.numpy() | (track.mask.numpy()[::stride, ::stride] & ~has_points))
