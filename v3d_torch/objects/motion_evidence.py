"""Evidence of object motion in one frame: Hough votes and Chamfer distances (paper, Sec. III-C, III-D), and free space.

All functions return their results. `MotionClassifier` updates the tracks with them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch

from v3d_torch.config import ChamferConfig, FreeSpaceConfig, VotingConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.appeared_pixels import MIN_REGION_SIDE, AppearedPixels
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.free_space_check import vacated_fractions
from v3d_torch.objects.intra_object_motion import intra_object_motion
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.objects.voting import vote_with_free_space
from v3d_torch.segmentation.coco import UNLABELLED

MOVED_FRACTION = 0.5
"""Minimum fraction of the visible points of a moved object that appeared or vacated: contours and partial occlusion
affect only a part of a static object."""

DEFORMED_FRACTION = 0.1
"""Minimum fraction of the visible points of a deformed object that appeared or vacated. The error of silhouettes is one
or two pixels, some hundredths of a person; a torso of 0.4 m that sways by 4 cm reaches this fraction."""

DetectionPairs = dict[Track, tuple[Detection3D, Detection3D]]
"""Earlier and newest detection of each object for which both exist."""


def detection_pairs(
    tracks: Iterable[Track], time_spans: Iterable[float], since: float = -torch.inf
) -> dict[float, DetectionPairs]:
    """Collect the pairs of detections to compare.

    Args:
        tracks: Tracks that are detected in the frame.
        time_spans: Minimum times between the two detections of a pair, seconds.
        since: Time of the first detection that can be compared, seconds.

    Returns:
        Pairs for each time span.
    """
    tracks = list(tracks)
    return {
        time_span: {track: pair for track in tracks if (pair := track.detection_pair(time_span, since)) is not None}
        for time_span in set(time_spans)
    }


@dataclass(frozen=True)
class FreeSpaceEvidence:
    """Result of the free-space check for the objects of a frame.

    Attributes:
        appeared_fractions: Fraction of each object's pixels that appeared, for each time span of the check; NaN if
            unknown.
        vacated_fractions: Fraction of the points of each earlier detection whose position is free space now; NaN if
            unknown.
        enabled: False if the free-space check is turned off.
    """

    appeared_fractions: dict[Track, list[float]]
    vacated_fractions: dict[Detection3D, float]
    enabled: bool

    def has_mostly_appeared(self, track: Track) -> bool:
        """Check whether most of an object appeared over some time span; False if the check is turned off."""
        return self.enabled and any(fraction >= MOVED_FRACTION for fraction in self.appeared_fractions[track])

    def allows_motion(self, track: Track, previous: Detection3D, min_fraction: float) -> bool:
        """Check whether enough of an object appeared or vacated.

        Args:
            track: Track of the object.
            previous: Earlier detection of the object.
            min_fraction: Minimum fraction of the object.

        Returns:
            True if the fraction is reached, or if the check is turned off.
        """
        fractions = (*self.appeared_fractions[track], self.vacated_fractions[previous])
        return not self.enabled or any(fraction >= min_fraction for fraction in fractions)


def free_space_evidence(
    tracks: list[Track],
    pairs: dict[float, DetectionPairs],
    view: DepthView,
    appeared_pixels: AppearedPixels,
    config: FreeSpaceConfig,
    camera: PinholeCamera,
) -> FreeSpaceEvidence:
    """Measure the appeared and vacated fractions of all objects.

    Args:
        tracks: Tracks of the frame.
        pairs: Pairs of detections for each time span.
        view: Depth and pose of the frame.
        appeared_pixels: Pixels of the frame that appeared.
        config: Tolerances.
        camera: Camera of the frame.
    """
    # Network masks are coarse: all known pixels of furniture beside a moving person can be those of the person.
    # Therefore furniture has moved only if most of all its pixels have appeared.
    of_all = [track.has_rigid_label for track in tracks]
    # A far unlabelled region is smaller than other objects, but each of its pixels was new when it was proposed.
    least = min(config.min_points, MIN_REGION_SIDE**2)
    min_pixels = [least if track.label == UNLABELLED else config.min_points for track in tracks]
    appeared = appeared_pixels.fractions([track.coarse_surface for track in tracks], min_pixels, of_all)
    previous = list(dict.fromkeys(earlier for of_time_span in pairs.values() for earlier, _ in of_time_span.values()))
    vacated = vacated_fractions([detection.cloud for detection in previous], view, camera, config)
    return FreeSpaceEvidence(
        appeared_fractions=dict(zip(tracks, appeared.tolist(), strict=True)),
        vacated_fractions=dict(zip(previous, vacated.tolist(), strict=True)),
        enabled=config.enabled,
    )


@dataclass(frozen=True)
class VoteEvidence:
    """Result of Hough voting over all time spans.

    Attributes:
        votes: Maximum number of votes of each compared object over the time spans.
        dynamic: Objects that are voted dynamic over some time span.
        vote_pairs: Votes that counted over some time span: id of the voting object and id of the object voted for,
            sorted.
    """

    votes: dict[Track, int]
    dynamic: set[Track]
    vote_pairs: list[tuple[int, int]]


def hough_vote_evidence(
    pairs_by_span: dict[float, DetectionPairs],
    free_space: FreeSpaceEvidence,
    previous_stamp: float,
    config: VotingConfig,
) -> VoteEvidence:
    """Vote over all time spans (paper, Alg. 1).

    Args:
        pairs_by_span: Pairs of detections for each time span.
        free_space: Result of the free-space check.
        previous_stamp: Timestamp of the previous frame, seconds.
        config: Time spans and thresholds.

    Returns:
        Votes and dynamic objects; empty if voting is turned off.
    """
    if not config.enabled:
        return VoteEvidence({}, set(), [])
    compared = [
        # Over a time span of 0, only objects of the previous frame are compared (Alg. 1).
        {track: pair for track, pair in pairs_by_span[span].items() if span > 0 or pair[0].stamp >= previous_stamp}
        for span in config.time_spans
    ]
    tracks = list(dict.fromkeys(track for pairs in compared for track in pairs))
    if not tracks:
        return VoteEvidence({}, set(), [])
    # One vote for all time spans at once, with a row for each object that is compared over any of them.
    shape, unknown = (len(compared), len(tracks)), torch.zeros(3, dtype=torch.float64)
    rows = [(track, pairs.get(track)) for pairs in compared for track in tracks]
    previous, current = (
        torch.stack([unknown if pair is None else pair[k].centroid for _, pair in rows]).view(*shape, 3) for k in (0, 1)
    )
    present = torch.tensor([pair is not None for _, pair in rows]).view(shape)
    moved = None
    if free_space.enabled:
        moved = torch.tensor(
            [pair is not None and free_space.allows_motion(track, pair[0], MOVED_FRACTION) for track, pair in rows]
        ).view(shape)
    votes, is_dynamic, counted_votes = vote_with_free_space(previous, current, moved, config, present)
    pairs_of_votes = counted_votes.any(dim=0).nonzero().tolist()
    return VoteEvidence(
        votes=dict(zip(tracks, votes.amax(dim=0).tolist(), strict=True)),
        dynamic={track for track, flag in zip(tracks, is_dynamic.any(dim=0).tolist(), strict=True) if flag},
        vote_pairs=sorted((tracks[voter].id, tracks[candidate].id) for candidate, voter in pairs_of_votes),
    )


@dataclass(frozen=True)
class ChamferEvidence:
    """Change of shape of the compared objects.

    Attributes:
        distances: Root-mean-square nearest-neighbour distance of each compared object, metres; NaN if a cloud is empty.
        deforming: Objects that deform.
    """

    distances: dict[Track, float]
    deforming: set[Track]


def chamfer_evidence(pairs: DetectionPairs, free_space: FreeSpaceEvidence, config: ChamferConfig) -> ChamferEvidence:
    """Compare the cloud of each object with its earlier cloud (paper, Sec. III-D).

    Args:
        pairs: Pairs of detections of the objects to compare.
        free_space: Result of the free-space check. An object deforms only if enough of it appeared or vacated.
        config: Threshold.
    """
    distances: dict[Track, float] = {}
    deforming: set[Track] = set()
    for track, (previous, current) in pairs.items():
        motion = intra_object_motion(previous.cloud[None], current.cloud[None], config.distance_threshold)
        distances[track] = float(motion.distance)
        if motion.deforming and free_space.allows_motion(track, previous, DEFORMED_FRACTION):
            deforming.add(track)
    return ChamferEvidence(distances, deforming)


@dataclass(frozen=True)
class MotionEvidence:
    """Evidence of motion in a frame.

    Attributes:
        free_space: Fractions of the objects that appeared or vacated.
        vote: Votes over all time spans.
        chamfer: Distances between clouds of objects that the vote leaves as static.
    """

    free_space: FreeSpaceEvidence
    vote: VoteEvidence
    chamfer: ChamferEvidence
