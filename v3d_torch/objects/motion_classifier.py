"""Who moves: votes between objects, deformation within them, the mask of what stands still (paper, III-C, III-D)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import isnan

import torch
from torch import Tensor

from v3d_torch.config import ObjectsConfig, VotingConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.objects.deformation import intra_object_motion
from v3d_torch.objects.feature_support import FeatureSupport
from v3d_torch.objects.free_space_check import DepthView, NewlyOccupied, vacated_fractions
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.objects.instance_tracker import InstanceTracker
from v3d_torch.objects.mask_ops import dilate
from v3d_torch.objects.mask_refiner import MaskRefiner
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.objects.voting import hough_vote
from v3d_torch.segmentation.coco import LIVING, PERSON, THINGS, class_name
from v3d_torch.types import Instances

Pairs = dict[Track, tuple[Detection3D, Detection3D]]


class MotionState(StrEnum):
    """What the object stage thinks of an object."""

    STATIC = "static"
    DYNAMIC = "dynamic"
    DEFORMING = "deforming"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class TrackedObject:
    """An object of one frame with its verdict.

    Attributes:
        id: number of the object.
        label: COCO class; `name` has it in words.
        mask: its pixels, bool, shape :math:`(H, W)`.
        centroid: world frame, metres, float64, shape :math:`(3,)`; nan when unknown.
        votes: of the newest frame, the most over the baselines.
        chamfer: root mean nearest-neighbour distance, metres; nan when it was not measured, as of who is voted dynamic.
        verdict: static, dynamic, deforming or unknown.
        missed: whether the network missed it, so that all but the id is predicted.
        cloud: as the network last saw it, world frame, metres, float32, shape :math:`(P, 3)`.
    """

    id: int
    label: int
    mask: Tensor
    centroid: Tensor
    votes: int
    chamfer: float
    motion_state: MotionState
    missed: bool
    cloud: Tensor

    @property
    def name(self) -> str:
        """Class and number, such as ``person 3``."""
        return f"{class_name(self.label)} {self.id}"


@dataclass(frozen=True)
class FrameObjects:
    """What the object stage says of one frame.

    Attributes:
        objects: by id.
        static: pixels that tracking may use, bool, shape :math:`(H, W)`.
        unpeopled: pixels of ``static`` that show no person, not even one who stands still, for the coloured map.
        ballots: votes between objects that counted, over any baseline: ids of who voted and for whom, sorted.
    """

    objects: list[TrackedObject]
    static_mask: Tensor
    static_without_people: Tensor
    vote_pairs: list[tuple[int, int]]


class MotionClassifier:
    """Keeps ids, lets objects vote, measures deformation and draws the static mask.

    Args:
        config: of the object stage.
        camera: of all frames.
    """

    def __init__(self, config: ObjectsConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self._last_stamp = -torch.inf
        self.tracker = InstanceTracker(config.tracker, camera, config.clouds.voxel_size)

    def __call__(
        self,
        instances: Instances,
        clouds: InstanceClouds,
        view: DepthView,
        arrivals: NewlyOccupied,
        witnesses: FeatureSupport,
    ) -> FrameObjects:
        """Judge the objects of a frame.

        Args:
            instances: of the frame.
            clouds: of the instances, camera frame.
            view: its depth, with the pose that the motion from the frame before gives it.
            arrivals: what came since earlier frames, see `FreeSpaceCheck`.
            witnesses: features, and which of them fit the camera's motion.
        """
        stamp = view.stamp
        tracks = self.tracker(stamp, instances, clouds, view.depth, invert(view.T_cw))
        shares = arrivals.fractions([track.cloud_pixels for track in tracks], self._config.free_space.min_points)
        came = dict(zip(tracks, shares.tolist(), strict=True))
        seen = [track for track in tracks if not track.missed]
        pairs = self._pairs(seen)
        left = self._vacated(pairs, view)
        votes, ballots = self._vote(seen, pairs, came, left, stamp)
        chamfer = self._deform(pairs, came, left, stamp)
        self._last_stamp = stamp
        fits = self._fit(tracks, witnesses)
        verdicts = {track: self._judge(track, came[track], stamp, fits[track]) for track in tracks}
        objects = [
            TrackedObject(
                id=track.id,
                label=track.label,
                mask=track.mask,
                centroid=track.predict(stamp),
                votes=votes.get(track, 0),
                chamfer=chamfer.get(track, torch.nan),
                motion_state=verdict,
                missed=track.missed,
                cloud=track.newest.cloud,
            )
            for track, verdict in verdicts.items()
        ]
        moving = [track for track, verdict in verdicts.items() if not self._may_be_tracked(verdict)]
        people = [track for track in tracks if track.label == PERSON]
        # Who moves is mostly a person: each outline is drawn once and serves both.
        drawn = list(dict.fromkeys([*moving, *people]))
        draw = MaskRefiner(
            drawn, view, arrivals, self._config.static_mask, self._camera, self._config.clouds.voxel_size
        )
        outlines = {track: draw(track) for track in drawn}
        size = view.depth.shape[-2:]
        static = self._clear_of([outlines[track] for track in moving], size)
        unpeopled = static & self._clear_of([outlines[track] for track in people], size)
        return FrameObjects(objects, static, unpeopled, ballots)

    def _fit(self, tracks: list[Track], witnesses: FeatureSupport) -> dict[Track, bool]:
        """Whether the features on each object fit the camera's motion."""
        config = self._config.static_mask
        vouched = witnesses.supports([track.cloud_pixels for track in tracks], config.fit_share, config.fit_least)
        return dict(zip(tracks, vouched.tolist(), strict=True))

    def _pairs(self, tracks: list[Track]) -> dict[float, Pairs]:
        """For each baseline, the sightings of each object that are compared."""
        baselines = {*self._config.voting.baselines, self._config.chamfer.baseline}
        return {
            baseline: {track: pair for track in tracks if (pair := track.detection_pair(baseline)) is not None}
            for baseline in baselines
        }

    def _vote(
        self,
        tracks: list[Track],
        compared: dict[float, Pairs],
        came: dict[Track, list[float]],
        left: dict[Detection3D, float],
        stamp: float,
    ) -> tuple[dict[Track, int], list[tuple[int, int]]]:
        """Votes of each object, the most over all baselines, and who cast them; marks those that are voted dynamic."""
        config, background = self._config.voting, self._config.free_space
        most: dict[Track, int] = {}
        cast: set[tuple[int, int]] = set()
        if not config.enabled:
            return most, []
        # What is seen for the first time has no distance that could have changed: the background alone has a vote.
        voted = {
            track
            for track in tracks
            if background.enabled and any(share >= background.moved_share for share in came[track])
        }
        for baseline in config.baselines:
            pairs = compared[baseline]
            if baseline == 0:  # the frame before: what it has not is not compared (Alg. 1)
                pairs = {track: pair for track, pair in pairs.items() if pair[0].stamp >= self._last_stamp}
            if not pairs:
                continue
            share = background.moved_share
            moved = torch.tensor(
                [self._has_moved(came[track], left[then], share) for track, (then, _) in pairs.items()]
            )
            then = torch.stack([then.centroid for then, _ in pairs.values()])
            now = torch.stack([now.centroid for _, now in pairs.values()])
            votes, dynamic, ballots = vote_with_free_space(then, now, moved if background.enabled else None, config)
            ids = [track.id for track in pairs]
            cast |= {(ids[voter], ids[elected]) for elected, voter in ballots.nonzero().tolist()}
            for track, count, elected in zip(pairs, votes.tolist(), dynamic.tolist(), strict=True):
                most[track] = max(most.get(track, 0), count)
                if elected:
                    voted.add(track)
        for track in voted:
            track.last_dynamic = stamp
            track.dynamic_frames += 1
        return most, sorted(cast)

    def _deform(
        self, compared: dict[float, Pairs], came: dict[Track, list[float]], left: dict[Detection3D, float], stamp: float
    ) -> dict[Track, float]:
        """Root mean Chamfer distance of each living object to its own past; marks those that deform.

        Not of those that the votes say move: this refines what they leave as static (paper, Sec. I).
        """
        config = self._config.chamfer
        share = self._config.free_space.deformed_share
        measured: dict[Track, float] = {}
        for track, (then, now) in compared[config.baseline].items() if config.enabled else ():
            if track.label not in LIVING or self._moves(track, stamp):
                continue
            motion = intra_object_motion(then.cloud[None], now.cloud[None], config.distance_threshold)
            measured[track] = float(motion.distance)
            if motion.deforming and self._has_moved(came[track], left[then], share):
                track.last_deforming = stamp
        return measured

    def _vacated(self, compared: dict[float, Pairs], view: DepthView) -> dict[Detection3D, float]:
        """Share of its places that each object has left since the sightings that are compared with it now."""
        then = list(dict.fromkeys(then for pairs in compared.values() for then, _ in pairs.values()))
        shares = vacated_fractions([sighting.cloud for sighting in then], view, self._camera, self._config.free_space)
        return dict(zip(then, shares.tolist(), strict=True))

    def _has_moved(self, came: list[float], left: float, share: float) -> bool:
        """Whether so much of an object has come, or has left its places; always, where the background has no say."""
        return not self._config.free_space.enabled or any(part >= share for part in (*came, left))

    def _judge(self, track: Track, came: list[float], stamp: float, fits: bool) -> MotionState:
        config = self._config.static_mask
        if track.last_dynamic == stamp:
            return MotionState.DYNAMIC
        filled = [share < self._config.free_space.still_share for share in came]
        # Over every baseline its places were filled: it stands there since the longest of them.
        still = len(came) > 0 and all(filled)
        if track.missed and (still or (track.score < config.bridge_score and track.last_dynamic == -torch.inf)):
            return MotionState.STATIC
        # Gaits pause, things do not: one whose places are filled, and are not known to have been empty, is at rest.
        known = [was for was, share in zip(filled, came, strict=True) if not isnan(share)]
        if track.label in THINGS and known and all(known):
            return MotionState.STATIC
        if self._moves(track, stamp):
            return MotionState.DYNAMIC
        if stamp - track.last_deforming <= config.hold_dynamic_time:
            return MotionState.DEFORMING
        doubted = track.label in LIVING and stamp - track.first_seen < config.confirm_static_time
        if doubted and not still and not fits:
            return MotionState.UNKNOWN
        return MotionState.STATIC

    def _moves(self, track: Track, stamp: float) -> bool:
        """Whether an object is voted dynamic, or was not long ago and often enough."""
        config = self._config.static_mask
        held = (
            stamp - track.last_dynamic <= config.hold_dynamic_time
            and track.dynamic_frames >= config.confirm_dynamic_frames
        )
        return held or track.last_dynamic == stamp

    def _may_be_tracked(self, verdict: MotionState) -> bool:
        deforming = verdict is MotionState.DEFORMING and self._config.chamfer.keep_deforming_features
        return deforming or verdict is MotionState.STATIC

    def _clear_of(self, outlines: list[Tensor], size: torch.Size) -> Tensor:
        """Pixels outside of the given objects, bool, shape (H, W)."""
        covered = torch.zeros(size, dtype=torch.bool)
        for outline in outlines:
            covered |= outline
        return ~dilate(covered, self._config.static_mask.dilation)


def vote_with_free_space(
    then: Tensor, now: Tensor, moved: Tensor | None, config: VotingConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """The paper's vote (Alg. 1), with the background as one more voter that has the casting vote.

    Args:
        then: centroids of K objects, world frame, metres, shape :math:`(K, 3)`.
        now: the same objects later.
        moved: whether the background says that each moved, bool, shape :math:`(K,)`; None for the paper's rule.
        config: thresholds.

    Returns:
        Votes for each, int64, and which are dynamic, bool, both of shape :math:`(K,)`; and the votes of objects that
        counted, of column j for row i, int64, shape :math:`(K, K)`.
    """
    present = torch.ones(then.shape[0], dtype=torch.bool)
    ballots = hough_vote(then, now, present, config.distance_threshold, config.vote_threshold).pair.to(torch.int64)
    if moved is None:
        votes = ballots.sum(dim=1)
        return votes, votes >= config.vote_threshold, ballots
    # Who moves cannot tell who else does, nor can who stands still but whose centroid, cut off, jumps.
    witness = ~moved & ((now - then).norm(dim=1) < 0.5 * config.distance_threshold)
    ballots = ballots * witness
    votes = ballots.sum(dim=1) + moved
    # Where fewer have a vote than are needed, all who have one must agree.
    voters = witness.sum() - witness.long() + 1
    return votes, moved & (votes >= voters.clamp(max=config.vote_threshold)), ballots
