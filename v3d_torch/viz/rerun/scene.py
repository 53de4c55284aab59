"""What the object stage says of a frame, as rerun shows it."""

from __future__ import annotations

import math

import cv2
import numpy as np
import rerun as rr
import torch
from matplotlib.colors import to_rgba
from numpy.typing import NDArray

from v3d_torch.objects.frame_objects import FrameObjects, MotionState
from v3d_torch.viz.ballots import Pair, lines_of
from v3d_torch.viz.figures import MOTION_STATE_COLOURS
from v3d_torch.viz.voting import VOTE_COLOUR

CLASS_IDS = {verdict: number for number, verdict in enumerate(MotionState, start=1)}
"""Class of each verdict in the recording; 0 is what belongs to no object."""


def verdict_classes() -> rr.AnnotationContext:
    """Name and colour of each class."""
    known = [(number, verdict.value, rgba(MOTION_STATE_COLOURS[verdict])) for verdict, number in CLASS_IDS.items()]
    return rr.AnnotationContext([(0, "", (0, 0, 0, 0)), *known])


def log_scene(stream: rr.RecordingStream, scene: FrameObjects) -> None:
    """Log masks and names on the image, clouds, centroids and votes in the world, and curves by object."""
    _log_masks(stream, scene)
    clouds = torch.cat([torch.zeros(0, 3), *(judged.cloud for judged in scene.objects)])
    sizes = [len(judged.cloud) for judged in scene.objects]
    classes = np.repeat([CLASS_IDS[judged.motion_state] for judged in scene.objects], sizes).astype(np.uint16)
    stream.log("world/objects", rr.Points3D(clouds.numpy(), class_ids=classes, show_labels=False))
    _log_votes(stream, scene)
    for judged in scene.objects:
        stream.log(f"votes/{judged.id}", rr.Scalars(judged.votes))
        if math.isfinite(judged.chamfer):
            stream.log(f"chamfer/{judged.id}", rr.Scalars(judged.chamfer))


def in_words(scene: FrameObjects) -> str:
    """A table of the objects in Markdown, what stands still last."""
    if not scene.objects:
        return "no objects"
    rows = ["| object | verdict | votes | Chamfer, m |", "|---|---|---:|---:|"]
    for judged in sorted(scene.objects, key=lambda judged: (judged.motion_state is MotionState.STATIC, judged.id)):
        missed = ", missed" if judged.missed else ""
        chamfer = f"{judged.chamfer:.3f}" if math.isfinite(judged.chamfer) else ""
        rows.append(f"| {judged.name} | {judged.motion_state.value}{missed} | {judged.votes} | {chamfer} |")
    return "\n".join(rows)


def rgba(colour: str) -> tuple[int, ...]:
    """A colour as bytes."""
    return tuple(round(255 * part) for part in to_rgba(colour))


def _log_masks(stream: rr.RecordingStream, scene: FrameObjects) -> None:
    classes = np.zeros(scene.static_mask.shape, dtype=np.uint8)
    for judged in scene.objects:
        classes[judged.mask.numpy()] = CLASS_IDS[judged.motion_state]
    stream.log("world/camera/image/masks", rr.SegmentationImage(classes, opacity=0.5))
    around = [(judged, cv2.boundingRect(judged.mask.numpy().view(np.uint8))) for judged in scene.objects]
    in_view = [(judged, sides) for judged, sides in around if sides[2] > 0]  # left, top, width, height
    boxes = rr.Boxes2D(
        mins=[sides[:2] for _, sides in in_view],
        sizes=[sides[2:] for _, sides in in_view],
        labels=[judged.name for judged, _ in in_view],
        class_ids=[CLASS_IDS[judged.motion_state] for judged, _ in in_view],
    )
    stream.log("world/camera/image/objects", boxes)


def _log_votes(stream: rr.RecordingStream, scene: FrameObjects) -> None:
    located = {judged.id: judged for judged in scene.objects if bool(judged.centroid.isfinite().all())}
    places = {number: judged.centroid.numpy() for number, judged in located.items()}
    centroids = rr.Points3D(
        np.array(list(places.values())).reshape(-1, 3),
        class_ids=[CLASS_IDS[judged.motion_state] for judged in located.values()],
        labels=[judged.name for judged in located.values()],
        radii=rr.Radius.ui_points(5.0),
    )
    stream.log("world/centroids", centroids)
    dynamic = [number for number, judged in located.items() if judged.motion_state is MotionState.DYNAMIC]
    counted, idle = lines_of([ballot for ballot in scene.vote_pairs if located.keys() >= set(ballot)], dynamic)
    stream.log("world/votes", _lines(counted, places, VOTE_COLOUR, 1.5))
    stream.log("world/votes/without_effect", _lines(idle, places, "lightcoral", 0.5))


def _lines(pairs: list[Pair], places: dict[int, NDArray[np.float64]], colour: str, width: float) -> rr.LineStrips3D:
    strips = [np.stack([places[one], places[other]]) for one, other in pairs]
    return rr.LineStrips3D(strips, colors=[rgba(colour)], radii=rr.Radius.ui_points(width))
