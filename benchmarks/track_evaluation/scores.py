"""Scores of people's tracks: HOTA, IDF1, MOTA and id switches by TrackEval, and the fraction of people's pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from track_evaluation.truth import IGNORED, TruePeople

_MAX_IGNORED = 0.5
"""Maximum fraction of a track on pixels that are not evaluated; with more, the track is left out in that frame."""


@dataclass(frozen=True)
class FrameOverlap:
    """Overlap of true people and tracks in one frame.

    Attributes:
        people: True people.
        tracks: Ids of the tracks.
        iou: Intersection over union of the masks, shape (people, tracks).
        pixels: Pixels of each person in each track, shape (people, tracks).
        areas: Pixels of each person, shape (people,).
    """

    people: tuple[int, ...]
    tracks: tuple[int, ...]
    iou: NDArray[np.float64]
    pixels: NDArray[np.int64]
    areas: NDArray[np.int64]


@dataclass(frozen=True)
class TrackScores:
    """Scores of a tracker on a sequence.

    Attributes:
        hota: Higher order tracking accuracy (Luiten et al., IJCV 2021).
        deta: Its detection accuracy.
        assa: Its association accuracy.
        idf1: F1 score of the identities (Ristani et al., ECCVW 2016).
        mota: Multi-object tracking accuracy (Bernardin and Stiefelhagen, 2008).
        id_switches: Number of id switches.
        id_switches_per_60_frames: Id switches per 60 frames in which a person is in view.
        pixels_right: Fraction of people's pixels in the one track of this person.
        tracks: Number of tracks.
        people: Number of people.
    """

    hota: float
    deta: float
    assa: float
    idf1: float
    mota: float
    id_switches: int
    id_switches_per_60_frames: float
    pixels_right: float
    tracks: int
    people: int


@dataclass(frozen=True)
class MaskOverlap:
    """Overlap of one mask with the true people of a frame.

    Attributes:
        pixels: Pixels of each person in the mask, shape (people,).
        area: Evaluated pixels of the mask.
        ignored: Pixels of the mask that are not evaluated.
    """

    pixels: NDArray[np.int64]
    area: int
    ignored: int


def mask_overlap(truth: TruePeople, mask: NDArray[np.bool_]) -> MaskOverlap:
    """Compare a mask of shape (H, W) with the true people of the frame."""
    counts = np.bincount(truth.owner[mask], minlength=IGNORED + 1)
    return MaskOverlap(counts[1 : 1 + len(truth.ids)], int(counts[:IGNORED].sum()), int(counts[IGNORED]))


def frame_overlap(truth: TruePeople, tracks: Mapping[int, MaskOverlap]) -> FrameOverlap:
    """Collect the overlaps of the tracks of a frame, given by their ids."""
    areas = np.bincount(truth.owner.ravel(), minlength=IGNORED + 1)[1 : 1 + len(truth.ids)]
    kept = {
        id_: mask
        for id_, mask in tracks.items()
        if mask.area > 0 and mask.ignored <= _MAX_IGNORED * (mask.area + mask.ignored)
    }
    pixels = np.array([mask.pixels for mask in kept.values()], np.int64).reshape(len(kept), len(areas)).T
    union = areas[:, None] + np.array([mask.area for mask in kept.values()], np.int64) - pixels
    return FrameOverlap(truth.ids, tuple(kept), pixels / np.maximum(union, 1), pixels, areas)


def score(frames: Sequence[FrameOverlap]) -> TrackScores:
    """Compute all scores of a sequence."""
    from trackeval.metrics import CLEAR, HOTA, Identity

    data, people, tracks = _trackeval_data(frames)
    quiet = {"PRINT_CONFIG": False}
    hota, clear, identity = (m.eval_sequence(data) for m in (HOTA(), CLEAR(quiet), Identity(quiet)))
    in_view = sum(len(frame.people) for frame in frames)
    return TrackScores(
        hota=float(np.mean(hota["HOTA"])),
        deta=float(np.mean(hota["DetA"])),
        assa=float(np.mean(hota["AssA"])),
        idf1=float(identity["IDF1"]),
        mota=float(clear["MOTA"]),
        id_switches=int(clear["IDSW"]),
        id_switches_per_60_frames=60 * int(clear["IDSW"]) / max(in_view, 1),
        pixels_right=_pixels_right(frames, people, tracks),
        tracks=len(tracks),
        people=len(people),
    )


def _trackeval_data(frames: Sequence[FrameOverlap]) -> tuple[dict[str, Any], dict[int, int], dict[int, int]]:
    """Return the input of TrackEval's metrics, and the number of each person and track in it."""
    people = {id_: i for i, id_ in enumerate(sorted({id_ for frame in frames for id_ in frame.people}))}
    tracks = {id_: i for i, id_ in enumerate(sorted({id_ for frame in frames for id_ in frame.tracks}))}
    data = {
        "num_timesteps": len(frames),
        "num_gt_ids": len(people),
        "num_tracker_ids": len(tracks),
        "num_gt_dets": sum(len(frame.people) for frame in frames),
        "num_tracker_dets": sum(len(frame.tracks) for frame in frames),
        "gt_ids": [np.array([people[id_] for id_ in frame.people], int) for frame in frames],
        "tracker_ids": [np.array([tracks[id_] for id_ in frame.tracks], int) for frame in frames],
        "similarity_scores": [frame.iou for frame in frames],
    }
    return data, people, tracks


def _pixels_right(frames: Sequence[FrameOverlap], people: dict[int, int], tracks: dict[int, int]) -> float:
    """Return the fraction of people's pixels in the right track, with at most one track for each person."""
    pixels = np.zeros((len(people), len(tracks)))
    for frame in frames:
        rows, columns = [people[id_] for id_ in frame.people], [tracks[id_] for id_ in frame.tracks]
        pixels[np.ix_(rows, columns)] += frame.pixels
    total = sum(int(frame.areas.sum()) for frame in frames)
    return float(pixels[linear_sum_assignment(pixels, maximize=True)].sum() / max(total, 1))
