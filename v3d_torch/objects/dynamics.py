"""Who moves: votes between objects, deformation within them, the mask of what stands still (paper, III-C, III-D)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import ObjectsConfig
from v3d_torch.objects.chamfer import chamfer_distance
from v3d_torch.objects.lift import ObjectClouds
from v3d_torch.objects.track import Track
from v3d_torch.objects.tracker import InstanceTracker
from v3d_torch.objects.voting import hough_vote
from v3d_torch.segmentation.coco import PERSON
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
    """

    objects: list[Judged]
    static: Tensor


class ObjectDynamics:
    """Keeps ids, lets objects vote, measures deformation and draws the static mask.

    Args:
        config: of the object stage.
        camera: tells which points both of two frames could see.
    """

    def __init__(self, config: ObjectsConfig, camera: PinholeCamera) -> None:
        self._config = config
        self._camera = camera
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
        votes = self._vote(stamp, [track for track in tracks if not track.missed])
        chamfer = self._deform(stamp, [track for track in tracks if not track.missed], T_wc)
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
        return Scene(objects, self._static_mask(objects, depth.shape[-2:]))

    def _vote(self, stamp: float, tracks: list[Track]) -> dict[int, int]:
        """Votes of each object, the most over all baselines; marks those that are voted dynamic."""
        config = self._config.voting
        most: dict[int, int] = {}
        if not config.enabled:
            return most
        for baseline in config.baselines:
            pairs = [(track, pair) for track in tracks if (pair := track.pair(baseline)) is not None]
            if not pairs:
                continue
            dynamic, votes = hold_election(
                torch.stack([then.centroid for _, (then, _) in pairs]),
                torch.stack([now.centroid for _, (_, now) in pairs]),
                distance_threshold=config.distance_threshold,
                vote_threshold=config.vote_threshold,
                background=config.background,
                withdraw=config.withdraw,
            )
            for i, (track, _) in enumerate(pairs):
                most[track.id] = max(most.get(track.id, 0), int(votes[i]))
                if dynamic[i]:
                    track.last_dynamic = stamp
        return most

    def _deform(self, stamp: float, tracks: list[Track], T_wc: Tensor) -> dict[int, float]:
        """Root mean Chamfer distance of each object to its own past; marks those that deform."""
        config = self._config.chamfer
        measured: dict[int, float] = {}
        if not config.enabled:
            return measured
        for track in tracks:
            pair = track.pair(config.baseline)
            if pair is None:
                continue
            then, now = pair
            squared = chamfer_distance(then.cloud[None], now.cloud[None])
            measured[track.id] = float((squared / 2).sqrt())
            if measured[track.id] >= config.distance_threshold:
                track.last_deforming = stamp
        return measured

    def _judge(self, track: Track, stamp: float) -> Verdict:
        config = self._config.mask
        if stamp - track.last_dynamic <= config.hold_dynamic:
            return Verdict.DYNAMIC
        if stamp - track.last_deforming <= config.hold_dynamic:
            return Verdict.DEFORMING
        if track.label == PERSON and stamp - track.first_seen < config.confirm_still:
            return Verdict.UNKNOWN
        return Verdict.STATIC

    def _static_mask(self, objects: list[Judged], size: torch.Size) -> Tensor:
        """Pixels outside of every object that moves or might, these grown by the margin."""
        left_out = torch.zeros(size, dtype=torch.bool)
        for judged in objects:
            if judged.verdict is Verdict.DEFORMING and self._config.chamfer.include_deforming:
                continue
            if judged.verdict is not Verdict.STATIC:
                left_out |= judged.mask
        side = 2 * self._config.mask.margin + 1
        grown = cv2.dilate(left_out.to(torch.uint8).numpy(), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
        return torch.from_numpy(grown == 0)


def hold_election(
    previous: Tensor,
    current: Tensor,
    *,
    distance_threshold: float,
    vote_threshold: int,
    background: bool,
    withdraw: bool,
) -> tuple[Tensor, Tensor]:
    """Alg. 1 of the paper, with two amendments that can be switched off.

    The background, which never moves, votes on each object by its displacement in the world; and an object once
    voted dynamic, the one with most votes first, loses its own votes, for else two walkers outvote every chair.

    Args:
        previous: centroids then, world frame, metres, shape :math:`(K, 3)`.
        current: centroids now, row by row the same objects.
        distance_threshold: T_d, metres.
        vote_threshold: T_v; where fewer have a vote (with ``background``), all of them must agree.
        background: whether the background votes.
        withdraw: whether dynamic objects lose their votes.

    Returns:
        Which objects are dynamic, bool, and the votes before any was withdrawn, int64, both of shape :math:`(K,)`.
    """
    present = torch.ones(previous.shape[0], dtype=torch.bool)
    ballots = hough_vote(previous, current, present, distance_threshold, vote_threshold).pair > 0
    if background:
        moved = (current - previous).norm(dim=1) >= distance_threshold
        ballots = torch.cat([ballots, moved[:, None]], dim=1)
        vote_threshold = min(vote_threshold, ballots.shape[1] - 1)
    votes = ballots.sum(dim=1)
    if not withdraw:
        return votes >= vote_threshold, votes
    dynamic = torch.zeros_like(present)
    standing = votes.clone()
    while True:
        leader = int(torch.where(dynamic, -1, standing).argmax())
        if dynamic[leader] or standing[leader] < vote_threshold:
            return dynamic, votes
        dynamic[leader] = True
        standing = standing - ballots[:, leader].long()
