"""Objects of a frame in a rerun recording: masks, clouds, centroids, votes and curves."""

from __future__ import annotations

import math

import cv2
import numpy as np
import rerun as rr
import torch
from matplotlib.colors import to_rgba
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.objects.frame_objects import FrameObjects, MotionState
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS
from v3d_torch.viz.voting import VOTE_COLOUR, IdPair, split_votes

CLASS_IDS = {motion_state: number for number, motion_state in enumerate(MotionState, start=1)}
"""Class id of each motion state in the recording; 0 is the background."""


def motion_state_classes() -> rr.AnnotationContext:
    """Return the name and colour of each class id."""
    classes = [(number, state.value, rgba(MOTION_STATE_COLOURS[state])) for state, number in CLASS_IDS.items()]
    return rr.AnnotationContext([(0, "", (0, 0, 0, 0)), *classes])


def log_objects(stream: rr.RecordingStream, frame_objects: FrameObjects, up: Tensor) -> None:
    """Log the objects of a frame: masks in the image, clouds, boxes, paths and votes in the world, and curves.

    Args:
        stream: Recording.
        frame_objects: Objects of the frame.
        up: Direction against gravity, world frame, shape :math:`(3,)`.
    """
    objects = frame_objects.objects
    _log_masks(stream, frame_objects)
    clouds = torch.cat([torch.zeros(0, 3), *(obj.cloud for obj in objects)])
    sizes = [len(obj.cloud) for obj in objects]
    classes = np.repeat([CLASS_IDS[obj.motion_state] for obj in objects], sizes).astype(np.uint16)
    stream.log("world/objects", rr.Points3D(clouds.numpy(), class_ids=classes, show_labels=False))
    _log_boxes(stream, frame_objects, up)
    _log_votes(stream, frame_objects)
    for obj in objects:
        stream.log(f"votes/{obj.id}", rr.Scalars(obj.votes))
        if math.isfinite(obj.chamfer):
            stream.log(f"chamfer/{obj.id}", rr.Scalars(obj.chamfer))


def format_objects(frame_objects: FrameObjects) -> str:
    """Return a Markdown table of the objects of a frame, static objects last."""
    if not frame_objects.objects:
        return "no objects"
    rows = ["| object | motion state | votes | change of shape, m |", "|---|---|---:|---:|"]
    for obj in sorted(frame_objects.objects, key=lambda obj: (obj.motion_state is MotionState.STATIC, obj.id)):
        missed = ", missed" if obj.missed else ""
        chamfer = f"{obj.chamfer:.3f}" if math.isfinite(obj.chamfer) else ""
        rows.append(f"| {obj.name} | {obj.motion_state.value}{missed} | {obj.votes} | {chamfer} |")
    return "\n".join(rows)


def rgba(colour: str) -> tuple[int, ...]:
    """Convert a colour of matplotlib to bytes."""
    return tuple(round(255 * part) for part in to_rgba(colour))


def _log_masks(stream: rr.RecordingStream, frame_objects: FrameObjects) -> None:
    classes = np.zeros(frame_objects.static_mask.shape, dtype=np.uint8)
    for obj in frame_objects.objects:
        classes[obj.mask.numpy()] = CLASS_IDS[obj.motion_state]
    stream.log("world/camera/image/masks", rr.SegmentationImage(classes, opacity=0.5))
    rectangles = [(obj, cv2.boundingRect(obj.mask.numpy().view(np.uint8))) for obj in frame_objects.objects]
    in_view = [(obj, rectangle) for obj, rectangle in rectangles if rectangle[2] > 0]  # left, top, width, height
    boxes = rr.Boxes2D(
        mins=[rectangle[:2] for _, rectangle in in_view],
        sizes=[rectangle[2:] for _, rectangle in in_view],
        labels=[obj.name for obj, _ in in_view],
        class_ids=[CLASS_IDS[obj.motion_state] for obj, _ in in_view],
    )
    stream.log("world/camera/image/objects", boxes)


def _log_boxes(stream: rr.RecordingStream, frame_objects: FrameObjects, up: Tensor) -> None:
    """Log the upright box of each object, and the path of the last seconds of those that move."""
    boxes, states = frame_objects.boxes(up), {obj.id: obj.motion_state for obj in frame_objects.objects}
    rotations = [box.T_wb[:3, :3].numpy() for box in boxes.values()]
    solids = rr.Boxes3D(
        centers=[box.T_wb[:3, 3].numpy() for box in boxes.values()],
        sizes=[box.size.numpy() for box in boxes.values()],
        quaternions=[rr.Quaternion(xyzw=Rotation.from_matrix(R).as_quat()) for R in rotations],
        class_ids=[CLASS_IDS[states[number]] for number in boxes],
    )
    stream.log("world/objects/boxes", solids)
    moving = [
        obj for obj in frame_objects.objects if obj.motion_state is not MotionState.STATIC and len(obj.history) > 1
    ]
    paths = rr.LineStrips3D(
        [np.stack([state.position.numpy() for state in obj.history]) for obj in moving],
        class_ids=[CLASS_IDS[obj.motion_state] for obj in moving],
    )
    stream.log("world/objects/paths", paths)


def _log_votes(stream: rr.RecordingStream, frame_objects: FrameObjects) -> None:
    with_position = {obj.id: obj for obj in frame_objects.objects if bool(obj.centroid.isfinite().all())}
    positions = {id_: obj.centroid.numpy() for id_, obj in with_position.items()}
    centroids = rr.Points3D(
        np.array(list(positions.values())).reshape(-1, 3),
        class_ids=[CLASS_IDS[obj.motion_state] for obj in with_position.values()],
        labels=[obj.name for obj in with_position.values()],
        radii=rr.Radius.ui_points(5.0),
    )
    stream.log("world/centroids", centroids)
    dynamic = [id_ for id_, obj in with_position.items() if obj.motion_state is MotionState.DYNAMIC]
    pairs = [pair for pair in frame_objects.vote_pairs if with_position.keys() >= set(pair)]
    effective, ineffective = split_votes(pairs, dynamic)
    stream.log("world/votes", _lines(effective, positions, VOTE_COLOUR, 1.5))
    stream.log("world/votes/without_effect", _lines(ineffective, positions, "lightcoral", 0.5))


def _lines(
    pairs: list[IdPair], positions: dict[int, NDArray[np.float64]], colour: str, width: float
) -> rr.LineStrips3D:
    strips = [np.stack([positions[first], positions[second]]) for first, second in pairs]
    return rr.LineStrips3D(strips, colors=[rgba(colour)], radii=rr.Radius.ui_points(width))
