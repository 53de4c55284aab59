"""Who moves: votes between objects, deformation within them, the mask of what stands still (paper, III-C, III-D)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import ObjectsConfig, VotingConfig
from v3d_torch.objects.background import moved_share
from v3d_torch.objects.chamfer import chamfer_distance
from v3d_torch.objects.lift import ObjectClouds
from v3d_torch.objects.track import Sighting, Track
from v3d_torch.objects.tracker import InstanceTracker
from v3d_torch.objects.voting import hough_vote
from v3d_torch.segmentation.coco import LIVING, PERSON
from v3d_torch.types import Instances


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
        label: COCO class.
        mask: its pixels, bool, shape :math:`(H, W)`.
        centroid: world frame, metres, float64, shape :math:`(3,)`; nan when unknown.
        votes: of the newest frame, the most over the baselines.
        chamfer: root mean nearest-neighbour distance, metres; nan when it was not measured.
        verdict: static, dynamic, deforming or unknown.
        missed: whether the network missed it, so that all but the id is predicted.
    """

    id: int
    label: int
    mask: Tensor
    centroid: Tensor
    votes: int
    chamfer: float
    verdict: Verdict
    missed: bool


@dataclass(frozen=True)
class Scene:
    """What the object stage says of one frame.

    Attributes:
        objects: by id.
        static: pixels that tracking may use, bool, shape :math:`(H, W)`.
        unpeopled: pixels of ``static`` that show no person, not even one who stands still, for the coloured map.
    """

    objects: list[Judged]
    static: Tensor
    unpeopled: Tensor


class ObjectDynamics:
    """Keeps ids, lets objects vote, measures deformation and draws the static mask.

    Args:
        config: of the object stage.
        camera: tells which points both of two frames could see.
    """

    def __init__(self, config: ObjectsConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
        self._last_stamp = -torch.inf
        self.tracker = InstanceTracker(config.identity, camera, config.clouds.voxel_size)

    def __call__(self, stamp: float, instances: Instances, clouds: ObjectClouds, depth: Tensor, T_wc: Tensor) -> Scene:
        """Judge the objects of a frame.

        Args:
            stamp: seconds.
            instances: of the frame.
            clouds: of the instances, camera frame.
            depth: metres, shape :math:`(1, H, W)`.
            T_wc: camera to world as the motion from the frame before gives it.
        """
        tracks = self.tracker(stamp, instances, clouds, depth, T_wc)
        seen = [track for track in tracks if not track.missed]
        votes = self._vote(stamp, seen)
        chamfer = self._deform(stamp, seen)
        self._last_stamp = stamp
        objects = [
            Judged(
                id=track.id,
                label=track.label,
                mask=track.mask,
                centroid=track.predict(stamp),
                votes=votes.get(track.id, 0),
                chamfer=chamfer.get(track.id, torch.nan),
                verdict=self._judge(track, stamp),
                missed=track.missed,
            )
            for track in tracks
        ]
        moving = [judged for judged in objects if not self._may_be_tracked(judged)]
        people = [judged for judged in objects if judged.label == PERSON]
        static = self._clear_of(moving, depth.shape[-2:])
        return Scene(objects, static, static & self._clear_of(people, depth.shape[-2:]))

    def _vote(self, stamp: float, tracks: list[Track]) -> dict[int, int]:
        """Votes of each object, the most over all baselines; marks those that are voted dynamic."""
        config = self._config.voting
        most: dict[int, int] = {}
        for baseline in config.baselines if config.enabled else ():
            pairs = {track: pair for track in tracks if (pair := track.pair(baseline)) is not None}
            if baseline == 0:  # the frame before: what it has not is not compared (Alg. 1)
                pairs = {track: pair for track, pair in pairs.items() if pair[0].stamp >= self._last_stamp}
            if not pairs:
                continue
            share = self._config.background.moved_share
            moved = torch.tensor([self._background_agrees(*pair, share) for pair in pairs.values()])
            then = torch.stack([then.centroid for then, _ in pairs.values()])
            now = torch.stack([now.centroid for _, now in pairs.values()])
            votes, dynamic = elect(then, now, moved if self._config.background.enabled else None, config)
            for track, count, voted in zip(pairs, votes.tolist(), dynamic.tolist(), strict=True):
                most[track.id] = max(most.get(track.id, 0), count)
                if voted:
                    track.last_dynamic = stamp
        return most

    def _deform(self, stamp: float, tracks: list[Track]) -> dict[int, float]:
        """Root mean Chamfer distance of each living object to its own past; marks those that deform."""
        config = self._config.chamfer
        share = self._config.background.deformed_share
        measured: dict[int, float] = {}
        for track in tracks if config.enabled else ():
            pair = track.pair(config.baseline)
            if pair is None or track.label not in LIVING:
                continue
            then, now = pair
            squared = chamfer_distance(then.cloud[None], now.cloud[None])
            measured[track.id] = float((squared / 2).sqrt())
            if measured[track.id] >= config.distance_threshold and self._background_agrees(then, now, share):
                track.last_deforming = stamp
        return measured

    def _background_agrees(self, then: Sighting, now: Sighting, share: float) -> bool:
        """Whether so much of an object has left its places; not where too little of them is in sight to tell."""
        config = self._config.background
        if not config.enabled:
            return True
        return moved_share((then.cloud, then.view), (now.cloud, now.view), self._camera, config) >= share

    def _judge(self, track: Track, stamp: float) -> Verdict:
        config = self._config.mask
        if stamp - track.last_dynamic <= config.hold_dynamic:
            return Verdict.DYNAMIC
        if stamp - track.last_deforming <= config.hold_dynamic:
            return Verdict.DEFORMING
        if track.label == PERSON and stamp - track.first_seen < config.confirm_still:
            return Verdict.UNKNOWN
        return Verdict.STATIC

    def _may_be_tracked(self, judged: Judged) -> bool:
        deforming = judged.verdict is Verdict.DEFORMING and self._config.chamfer.include_deforming
        return deforming or judged.verdict is Verdict.STATIC

    def _clear_of(self, objects: list[Judged], size: torch.Size) -> Tensor:
        """Pixels outside of the given objects, these grown by the margin, bool, shape (H, W)."""
        covered = torch.zeros(size, dtype=torch.bool)
        for judged in objects:
            covered |= judged.mask
        side = 2 * self._config.mask.margin + 1
        grown = cv2.dilate(covered.to(torch.uint8).numpy(), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
        return torch.from_numpy(grown == 0)


def elect(then: Tensor, now: Tensor, moved: Tensor | None, config: VotingConfig) -> tuple[Tensor, Tensor]:
    """The paper's vote (Alg. 1), with the background as one more voter that has the casting vote.

    Args:
        then: centroids of K objects, world frame, metres, shape :math:`(K, 3)`.
        now: the same objects later.
        moved: whether the background says that each moved, bool, shape :math:`(K,)`; None for the paper's rule.
        config: thresholds.

    Returns:
        Votes for each, int64, and which are dynamic, bool, both of shape :math:`(K,)`.
    """
    present = torch.ones(then.shape[0], dtype=torch.bool)
    ballots = hough_vote(then, now, present, config.distance_threshold, config.vote_threshold).pair.to(torch.int64)
    if moved is None:
        votes = ballots.sum(dim=1)
        return votes, votes >= config.vote_threshold
    # Who moves cannot tell who else does, nor can who stands still but whose centroid, cut off, jumps.
    witness = ~moved & ((now - then).norm(dim=1) < 0.5 * config.distance_threshold)
    votes = (ballots * witness).sum(dim=1) + moved
    # Where fewer have a vote than are needed, all who have one must agree.
    voters = witness.sum() - witness.long() + 1
    return votes, moved & (votes >= voters.clamp(max=config.vote_threshold))
