"""Propagation of object masks to a frame without segmentation.

A network that sees every second frame halves the largest cost of a frame. Between two of its frames an object moves by
a few centimetres, which its track predicts, and the depth of the new frame shows its outline: the pixels near the
predicted points with the depth of these points. The objects of propagated masks are measured like those of the network,
so that centroids, votes and Chamfer distances use the new depth and not a prediction.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.free_space_check import DepthView
from v3d_torch.objects.silhouette import silhouettes
from v3d_torch.objects.track import Track
from v3d_torch.segmentation.coco import UNLABELLED
from v3d_torch.types import Instances

_DEPTH_TOLERANCE = 0.2
"""Tolerance of the depth around the predicted points, metres: arms and legs swing by this much between two frames."""


def propagate_instances(tracks: Sequence[Track], view: DepthView, camera: PinholeCamera, spacing: float) -> Instances:
    """Redraw the objects that were detected in the previous frame and may move.

    Unlabelled objects are left out, because they are found anew in the depth of each frame; furniture, because its
    pixels are used for tracking.

    Args:
        tracks: Tracks after the previous frame.
        view: Depth and pose of the frame.
        camera: Camera of the frame.
        spacing: Spacing of the points of the tracks, metres.

    Returns:
        Instances with the classes of the tracks, score 0 and empty boxes.
    """
    detected = [
        track
        for track in tracks
        if track.may_move and not track.missed and track.newest.is_located and track.label != UNLABELLED
    ]
    R, t = view.T_cw[:3, :3], view.T_cw[:3, 3]
    projected = silhouettes([track.predict_cloud(view.stamp) @ R.T + t for track in detected], camera, spacing)
    masks = [each.mask(view.depth, 0, _DEPTH_TOLERANCE, include_missing=True) for each in projected]
    if not masks:
        return Instances.empty(*view.depth.shape[-2:])
    labels = torch.tensor([track.label for track in detected])
    return Instances(torch.stack(masks), labels, torch.zeros(len(masks)), torch.zeros(len(masks), 4))
