"""Log-likelihood ratios of all pairs of tracks and instances of a frame: positions, masks, appearance and class."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.config import CloudConfig, TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.packed_masks import count_common_pixels, count_pixels, pack_masks
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.objects.appearance import histogram_similarity
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.objects.log_ratios import (
    appearance_log_ratio,
    class_log_ratio,
    overlap_log_ratio,
    position_log_ratio,
)
from v3d_torch.objects.mask_propagation import predict_mask
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.objects.resampling import subsample
from v3d_torch.objects.silhouette import Silhouette, silhouettes
from v3d_torch.objects.track import Detection3D, Track, predict_clouds
from v3d_torch.types import Instances

_MIN_VISIBLE_FRACTION = 0.5
"""An object is visible at its predicted position if the depth agrees with more than this fraction of its points."""

_MAX_BESIDE_COVERAGE = 0.1
"""An instance does not overlap a predicted mask if their intersection is less than this fraction of the smaller
area."""

_MIN_COVERAGE = 0.5
"""An instance covers a predicted mask if their intersection is at least this fraction of the smaller area."""


@dataclass(frozen=True)
class DetectedInstances:
    """Instances of a frame, prepared for the comparison with tracks.

    Attributes:
        stamp: Timestamp, seconds.
        labels: Class of each of N instances, int64, shape :math:`(N,)`.
        detections: Detections of the instances.
        coarse_masks: Every n-th pixel of the masks, packed, uint8, shape :math:`(N, B)`.
        coarse_surfaces: Every n-th pixel of the masks whose depth belongs to the object, packed, uint8, shape
            :math:`(N, B)`.
        appearance: Colour histograms, float32, shape :math:`(N, D)`, NaN if unknown; None if they are not compared.
    """

    stamp: float
    labels: Tensor
    detections: Sequence[Detection3D]
    coarse_masks: Tensor
    coarse_surfaces: Tensor
    appearance: Tensor | None

    def __len__(self) -> int:
        return len(self.detections)


@dataclass(frozen=True)
class PredictedTracks:
    """Tracks predicted to the time of a frame.

    Attributes:
        tracks: T tracks.
        states: State of each track at the time of the frame.
        silhouettes: Projection of the newest cloud of each track at its predicted position.
        coarse_masks: Every n-th pixel of the predicted masks, packed, uint8, shape :math:`(T, B)`.
        visible_fractions: Fraction of the predicted points whose depth is the measured depth, float64, shape
            :math:`(T,)`.
    """

    tracks: Sequence[Track]
    states: Sequence[ObjectState]
    silhouettes: Sequence[Silhouette]
    coarse_masks: Tensor
    visible_fractions: Tensor

    @property
    def visible(self) -> Tensor:
        """Tracks that are visible at their predicted position, bool, shape (T,)."""
        return self.visible_fractions > _MIN_VISIBLE_FRACTION


def to_detections(
    stamp: float,
    instances: Instances,
    clouds: InstanceClouds,
    appearance: Tensor | None,
    T_wc: Tensor,
    stride: int,
) -> DetectedInstances:
    """Transform the instances of a frame into the world frame and to coarse masks.

    Args:
        stamp: Timestamp, seconds.
        instances: Instances of the frame.
        clouds: Clouds of the instances, camera frame.
        appearance: Colour histograms of the instances, float32, shape :math:`(N, D)`; None if unknown.
        T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
        stride: Step between the coarse pixels, pixels.
    """
    centroids = transform_points(T_wc, clouds.centroid.to(torch.float64))
    points = transform_points(T_wc, clouds.points[clouds.valid]).split(clouds.valid.sum(dim=1).tolist())
    detections = [Detection3D(stamp, *each) for each in zip(centroids, points, strict=True)]
    coarse_masks, coarse_surfaces = (pack_masks(each, stride) for each in (instances.masks, clouds.cloud_pixels))
    return DetectedInstances(stamp, instances.labels, detections, coarse_masks, coarse_surfaces, appearance)


def predict_tracks(
    tracks: Sequence[Track],
    stamp: float,
    depth: Tensor,
    T_cw: Tensor,
    camera: PinholeCamera,
    config: CloudConfig,
    stride: int,
) -> PredictedTracks:
    """Predict tracks, and check whether they are visible at their predicted positions.

    Args:
        tracks: Tracks.
        stamp: Timestamp, seconds.
        depth: Depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.
        T_cw: World-to-camera pose, float64, shape :math:`(4, 4)`.
        camera: Camera of the frame.
        config: Spacing and maximum depth of the points of the clouds.
        stride: Step between the coarse pixels, pixels.
    """
    states = [track.predict_state(stamp) for track in tracks]
    projected = silhouettes(predict_clouds(tracks, states, T_cw), camera, config.voxel_size)
    coarse_depth = subsample(depth, stride)
    masks = [
        predict_mask(track, each, coarse_depth, config.max_depth, stride=stride)
        for track, each in zip(tracks, projected, strict=True)
    ]
    return PredictedTracks(
        tuple(tracks),
        states,
        projected,
        pack_masks(torch.stack(masks) if masks else torch.zeros(0, *coarse_depth.shape[1:], dtype=torch.bool)),
        torch.tensor([each.visible_fraction(depth) for each in projected], dtype=torch.float64),
    )


def compare_tracks(
    predicted: PredictedTracks, without_masks: Sequence[Track], detected: DetectedInstances, config: TrackerConfig
) -> Tensor:
    """Add up the log-likelihood ratios of each pair of a track and an instance.

    An instance can continue a track of its class if it lies within the gate; if the mask of the track is predicted, see
    `_compare_masks` for more. The size of the visible part of a track without a predicted mask, for the log ratio of
    appearances, is the mean over its detections: the last visible part of an object that left the image is small.

    Args:
        predicted: T tracks whose masks are predicted.
        without_masks: U other tracks.
        detected: N instances.
        config: Gates.

    Returns:
        Log-likelihood ratio of each pair, -inf if it is impossible, float64, shape :math:`(T + U, N)`.
    """
    tracks, stamp, count = [*predicted.tracks, *without_masks], detected.stamp, len(predicted.tracks)
    if not tracks:
        return torch.zeros(0, len(detected), dtype=torch.float64)
    states = [*predicted.states, *(track.predict_unobserved_state(stamp) for track in without_masks)]
    points: list[float] = [len(track.newest.cloud) for track in predicted.tracks]
    points += [track.appearance_points for track in without_masks]
    elapsed = torch.tensor([[stamp - track.newest.stamp] for track in tracks], dtype=torch.float64)
    same_class = torch.tensor([track.label for track in tracks])[:, None] == detected.labels
    squared_distance = _squared_distances(states, detected)
    near = squared_distance.sqrt() <= config.max_jump + config.max_speed * elapsed  # the maximum motion of the track
    possible = same_class & near
    of_masks = torch.zeros_like(squared_distance)
    if count:
        of_masks[:count], possible[:count] = _compare_masks(
            predicted, detected, same_class[:count], near[:count], config.min_overlap
        )
    log_ratio = (
        _position_log_ratio(squared_distance, tracks, states, detected, possible)
        + of_masks
        + _appearance_log_ratio(tracks, detected, elapsed, points)
        + class_log_ratio(same_class)
    )
    return log_ratio.masked_fill(~possible, -torch.inf)


def _compare_masks(
    predicted: PredictedTracks, detected: DetectedInstances, same_class: Tensor, near: Tensor, min_overlap: float
) -> tuple[Tensor, Tensor]:
    """Add up the log-likelihood ratios of masks and of vacated places.

    An instance can continue a track of its class if it lies within the gate or covers the predicted mask. It can
    continue a track of any class if it overlaps the last or the predicted mask, because the position jumps when an
    object is partly hidden. By its position alone, an instance that does not overlap the predicted mask of a visible
    track does not continue it.

    Args:
        predicted: T tracks.
        detected: N instances.
        same_class: Pairs of the same class, bool, shape (T, N).
        near: Pairs within the gate, bool, shape (T, N).
        min_overlap: Minimum intersection over union of a pair of different classes.

    Returns:
        Log-likelihood ratio, float64, and whether the pair is possible, bool, shape (T, N).
    """
    # The last mask is accurate if little moves; the predicted mask follows fast walkers and a turning camera.
    last_masks = torch.stack([track.coarse_mask for track in predicted.tracks])
    intersection = count_common_pixels(predicted.coarse_masks, detected.coarse_masks)
    areas, predicted_areas = count_pixels(detected.coarse_masks), count_pixels(predicted.coarse_masks)[:, None]
    coverage = (intersection / torch.minimum(predicted_areas, areas).clamp(min=1)).to(torch.float64)
    overlap = torch.maximum(
        _intersection_over_union(
            count_common_pixels(last_masks, detected.coarse_masks), count_pixels(last_masks)[:, None], areas
        ),
        _intersection_over_union(intersection, predicted_areas, areas),
    )
    beside = predicted.visible[:, None] & (coverage < _MAX_BESIDE_COVERAGE)
    possible = (same_class & ((near & ~beside) | (coverage >= _MIN_COVERAGE))) | (overlap >= min_overlap)
    visible = predicted.visible_fractions * (predicted_areas[:, 0] > 0)
    vacated = torch.tensor([[track.vacated_log_ratio] for track in predicted.tracks], dtype=torch.float64)
    return overlap_log_ratio(coverage, overlap, visible) + vacated, possible


def _squared_distances(states: Sequence[ObjectState], detected: DetectedInstances) -> Tensor:
    """Squared distance of each centroid from each predicted position, square metres, NaN if unknown, shape (T, N)."""
    predicted = torch.stack([state.position for state in states])
    observed = torch.stack([detection.centroid for detection in detected.detections])
    return (observed - predicted[:, None]).square().sum(dim=2)


def _position_log_ratio(
    squared_distance: Tensor,
    tracks: Sequence[Track],
    states: Sequence[ObjectState],
    detected: DetectedInstances,
    possible: Tensor,
) -> Tensor:
    """Log ratio of the positions of possible pairs with the predicted states, 0 for other pairs, shape (T, N)."""
    variance = torch.ones_like(squared_distance)
    variances = variance.numpy()  # NumPy is faster than torch for single elements
    for i, j in possible.nonzero().tolist():
        variances[i, j] = states[i].variances[0] + tracks[i].centroid_sigma(detected.detections[j]) ** 2
    return position_log_ratio(squared_distance.masked_fill(~possible, torch.nan), variance)


def _appearance_log_ratio(
    tracks: Sequence[Track], detected: DetectedInstances, elapsed: Tensor, tracked_points: Sequence[float]
) -> Tensor:
    """Log ratio of appearances, shape (T, N), with the points of the tracks' views; 0 if they are not compared."""
    if detected.appearance is None:
        return torch.zeros(len(tracks), len(detected), dtype=torch.float64)
    unknown = torch.full_like(detected.appearance[0], torch.nan)
    known = [track.appearance for track in tracks]
    appearance = torch.stack([unknown if each is None or each.shape != unknown.shape else each for each in known])
    similarity = histogram_similarity(appearance, detected.appearance).to(torch.float64)
    tracked = torch.tensor(tracked_points, dtype=torch.float64)[:, None]
    points = torch.tensor([len(detection.cloud) for detection in detected.detections], dtype=torch.float64)
    return appearance_log_ratio(similarity, elapsed, torch.minimum(tracked, points), torch.maximum(tracked, points))


def _intersection_over_union(intersection: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the intersection over union from areas of intersections (A, B) and masks (A, 1) and (B,), float64."""
    return (intersection / (a + b - intersection).clamp(min=1)).to(torch.float64)
