"""Who moves: votes between objects, deformation within them, the mask of what stands still (paper, III-C, III-D)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import isnan

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import ObjectsConfig, VotingConfig
from v3d_torch.lie import invert
from v3d_torch.objects.background import Arrivals, DepthView, vacated_shares
from v3d_torch.objects.intra_motion import intra_object_motion
from v3d_torch.objects.lift import ObjectClouds
from v3d_torch.objects.outlines import Outliner
from v3d_torch.objects.regions import grown
from v3d_torch.objects.track import Sighting, Track
from v3d_torch.objects.tracker import InstanceTracker
from v3d_torch.objects.voting import hough_vote
from v3d_torch.objects.witnesses import Witnesses
from v3d_torch.segmentation.coco import LIVING, PERSON, THINGS, class_name
from v3d_torch.types import Instances

Pairs = dict[Track, tuple[Sighting, Sighting]]


class Verdict(StrEnum):
    """What the object stage thinks of an object."""

    STATIC = "static"
    DYNAMIC = "dynamic"
    DEFORMING = "deforming"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Judged:
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
    verdict: Verdict
    missed: bool
    cloud: Tensor

    @property
    def name(self) -> str:
        """Class and number, such as ``person 3``."""
        return f"{class_name(self.label)} {self.id}"


@dataclass(frozen=True)
class Scene:
    """What the object stage says of one frame.

    Attributes:
        objects: by id.
        static: pixels that tracking may use, bool, shape :math:`(H, W)`.
        unpeopled: pixels of ``static`` that show no person, not even one who stands still, for the coloured map.
        ballots: votes between objects that counted, over any baseline: ids of who voted and for whom, sorted.
    """

    objects: list[Judged]
    static: Tensor
    unpeopled: Tensor
    ballots: list[tuple[int, int]]


class ObjectDynamics:
    """Keeps ids, lets objects vote, measures deformation and draws the static mask.

    Args:
        config: of the object stage.
        camera: of all frames.
    """

    def __init__(self, config: ObjectsConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self._last_stamp = -torch.inf
        self.tracker = InstanceTracker(config.identity, camera, config.clouds.voxel_size)

    def __call__(
        self, instances: Instances, clouds: ObjectClouds, view: DepthView, arrivals: Arrivals, witnesses: Witnesses
    ) -> Scene:
        """Judge the objects of a frame.

        Args:
            instances: of the frame.
            clouds: of the instances, camera frame.
            view: its depth, with the pose that the motion from the frame before gives it.
            arrivals: what came since earlier frames, see `BackgroundWatch`.
            witnesses: features, and which of them fit the camera's motion.
        """
        stamp = view.stamp
        tracks = self.tracker(stamp, instances, clouds, view.depth, invert(view.T_cw))
        shares = arrivals.shares([track.own for track in tracks], self._config.background.min_points)
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
            Judged(
                id=track.id,
                label=track.label,
                mask=track.mask,
                centroid=track.predict(stamp),
                votes=votes.get(track, 0),
                chamfer=chamfer.get(track, torch.nan),
                verdict=verdict,
                missed=track.missed,
                cloud=track.newest.cloud,
            )
            for track, verdict in verdicts.items()
        ]
        moving = [track for track, verdict in verdicts.items() if not self._may_be_tracked(verdict)]
        people = [track for track in tracks if track.label == PERSON]
        # Who moves is mostly a person: each outline is drawn once and serves both.
        drawn = list(dict.fromkeys([*moving, *people]))
        draw = Outliner(drawn, view, arrivals, self._config.mask, self._camera, self._config.clouds.voxel_size)
        outlines = {track: draw(track) for track in drawn}
        size = view.depth.shape[-2:]
        static = self._clear_of([outlines[track] for track in moving], size)
        unpeopled = static & self._clear_of([outlines[track] for track in people], size)
        return Scene(objects, static, unpeopled, ballots)

    def _fit(self, tracks: list[Track], witnesses: Witnesses) -> dict[Track, bool]:
        """Whether the features on each object fit the camera's motion."""
        config = self._config.mask
        vouched = witnesses.vouch_for([track.own for track in tracks], config.fit_share, config.fit_least)
        return dict(zip(tracks, vouched.tolist(), strict=True))

    def _pairs(self, tracks: list[Track]) -> dict[float, Pairs]:
        """For each baseline, the sightings of each object that are compared."""
        baselines = {*self._config.voting.baselines, self._config.chamfer.baseline}
        return {
            baseline: {track: pair for track in tracks if (pair := track.pair(baseline)) is not None}
            for baseline in baselines
        }

    def _vote(
        self,
        tracks: list[Track],
        compared: dict[float, Pairs],
        came: dict[Track, list[float]],
        left: dict[Sighting, float],
        stamp: float,
    ) -> tuple[dict[Track, int], list[tuple[int, int]]]:
        """Votes of each object, the most over all baselines, and who cast them; marks those that are voted dynamic."""
        config, background = self._config.voting, self._config.background
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
            votes, dynamic, ballots = elect(then, now, moved if background.enabled else None, config)
            ids = [track.id for track in pairs]
            cast |= {(ids[voter], ids[elected]) for elected, voter in ballots.nonzero().tolist()}
            for track, count, elected in zip(pairs, votes.tolist(), dynamic.tolist(), strict=True):
                most[track] = max(most.get(track, 0), count)
                if elected:
                    voted.add(track)
        for track in voted:
            track.last_dynamic = stamp
            track.evidence += 1
        return most, sorted(cast)

    def _deform(
        self, compared: dict[float, Pairs], came: dict[Track, list[float]], left: dict[Sighting, float], stamp: float
    ) -> dict[Track, float]:
        """Root mean Chamfer distance of each living object to its own past; marks those that deform.

        Not of those that the votes say move: this refines what they leave as static (paper, Sec. I).
        """
        config = self._config.chamfer
        share = self._config.background.deformed_share
        measured: dict[Track, float] = {}
        for track, (then, now) in compared[config.baseline].items() if config.enabled else ():
            if track.label not in LIVING or self._moves(track, stamp):
                continue
            motion = intra_object_motion(then.cloud[None], now.cloud[None], config.distance_threshold)
            measured[track] = float(motion.distance)
            if motion.deforming and self._has_moved(came[track], left[then], share):
                track.last_deforming = stamp
        return measured

    def _vacated(self, compared: dict[float, Pairs], view: DepthView) -> dict[Sighting, float]:
        """Share of its places that each object has left since the sightings that are compared with it now."""
        then = list(dict.fromkeys(then for pairs in compared.values() for then, _ in pairs.values()))
        shares = vacated_shares([sighting.cloud for sighting in then], view, self._camera, self._config.background)
        return dict(zip(then, shares.tolist(), strict=True))

    def _has_moved(self, came: list[float], left: float, share: float) -> bool:
        """Whether so much of an object has come, or has left its places; always, where the background has no say."""
        return not self._config.background.enabled or any(part >= share for part in (*came, left))

    def _judge(self, track: Track, came: list[float], stamp: float, fits: bool) -> Verdict:
        config = self._config.mask
        if track.last_dynamic == stamp:
            return Verdict.DYNAMIC
        filled = [share < self._config.background.still_share for share in came]
        # Over every baseline its places were filled: it stands there since the longest of them.
        still = len(came) > 0 and all(filled)
        if track.missed and (still or (track.score < config.bridge_score and track.last_dynamic == -torch.inf)):
            return Verdict.STATIC
        # Gaits pause, things do not: one whose places are filled, and are not known to have been empty, is at rest.
        known = [was for was, share in zip(filled, came, strict=True) if not isnan(share)]
        if track.label in THINGS and known and all(known):
            return Verdict.STATIC
        if self._moves(track, stamp):
            return Verdict.DYNAMIC
        if stamp - track.last_deforming <= config.hold_dynamic:
            return Verdict.DEFORMING
        doubted = track.label in LIVING and stamp - track.first_seen < config.confirm_still
        if doubted and not still and not fits:
            return Verdict.UNKNOWN
        return Verdict.STATIC

    def _moves(self, track: Track, stamp: float) -> bool:
        """Whether an object is voted dynamic, or was not long ago and often enough."""
        config = self._config.mask
        held = stamp - track.last_dynamic <= config.hold_dynamic and track.evidence >= config.confirm_moving
        return held or track.last_dynamic == stamp

    def _may_be_tracked(self, verdict: Verdict) -> bool:
        deforming = verdict is Verdict.DEFORMING and self._config.chamfer.include_deforming
        return deforming or verdict is Verdict.STATIC

    def _clear_of(self, outlines: list[Tensor], size: torch.Size) -> Tensor:
        """Pixels outside of the given objects, bool, shape (H, W)."""
        covered = torch.zeros(size, dtype=torch.bool)
        for outline in outlines:
            covered |= outline
        return ~grown(covered, self._config.mask.seam)


def elect(then: Tensor, now: Tensor, moved: Tensor | None, config: VotingConfig) -> tuple[Tensor, Tensor, Tensor]:
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
