"""Diagnosis of a run that reached the end of its sequence with incomplete results."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.realtime_playback import stored_source
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.evaluation.evaluation import MIN_PAIRS
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.request import RunRequest
from v3d_torch.types import RGBDFrame, TrackingStatus

_SAMPLES = 5
"""Number of frames that are examined."""

_MAX_PLAIN_SIGMA = 4.0
"""Maximum standard deviation of the grey values (0 to 255) of an image without content: sensor noise in the dark."""

_MAX_EMPTY_FRACTION = 0.01
"""Maximum fraction of pixels with depth in a depth image without content."""

_MAX_NEAR_FRACTION = 0.5
"""Maximum fraction of the depth of an image within `features.max_depth`, if the rest is the cause of the loss: people
can be near although the room is too far."""

_MIN_IMAGE_SIZE = 96
"""Minimum number of rows and of columns of an image in which enough features are found in most scenes."""


def diagnose(pipeline: Pipeline, request: RunRequest, evaluation_error: str | None) -> str | None:
    """Explain incomplete results of a run that ended without an error.

    Args:
        pipeline: Pipeline that has run.
        request: Inputs of the run.
        evaluation_error: Why it could not be scored, see `ResultTables`; None if it was, or without ground truth.

    Returns:
        One sentence with cause and fix; None if the results are complete.
    """
    name, count = pipeline.sequence.name, len(pipeline.slam.poses)
    if not count:
        return f"{name}: has no frames; record it again"
    if pipeline.slam.poses.was_found:
        return pipeline.record.mask_error or _cause_of_missing_scores(pipeline, evaluation_error)
    if request.load_map is not None:
        return (
            f"{request.load_map}: no frame of {request.seq} was localised in this map; pass a map of the same place,"
            " check the depth_scale, or run without --load-map"
        )
    cause = _cause_of_loss(pipeline, pipeline.record.times.indices)
    return f"{name}: the camera was not found in any of the {count} frames, {cause}"


def check_lost_frames(pipeline: Pipeline) -> list[str]:
    """Check whether a run that reached the end of its sequence lost more than half of the frames, but not all.

    Args:
        pipeline: Pipeline that has run.

    Returns:
        A sentence with cause and fix, or nothing.
    """
    indices = pipeline.record.times.indices
    statuses = pipeline.slam.poses.statuses[: len(indices)]  # there is one more if a frame was interrupted
    lost = torch.tensor([status is TrackingStatus.LOST for status in statuses], dtype=torch.bool)
    if not len(statuses) / 2 < int(lost.sum()) < len(statuses):
        return []
    cause = _cause_of_loss(pipeline, indices[lost])
    return [f"{int(lost.sum())} of {len(statuses)} frames are lost: {cause}"]


@torch.inference_mode()  # stages are called, in the mode in which they ran
def _cause_of_loss(pipeline: Pipeline, indices: Tensor) -> str:
    """Return cause and fix of the loss of frames, given by their indices in the sequence, int64, (N,)."""
    sequence, max_depth = stored_source(pipeline.sequence), pipeline.slam.config.features.max_depth
    if isinstance(sequence, RGBDSequence):
        samples = np.linspace(0, len(indices) - 1, min(_SAMPLES, len(indices))).astype(int)
        frames = [sequence[int(indices[sample])] for sample in samples]
        if all(float(frame.image.float().std()) < _MAX_PLAIN_SIGMA for frame in frames):
            return "the colour images are uniform; record it again, with light and an uncovered lens"
        fractions = [float((frame.depth > 0).float().mean()) for frame in frames]
        if not any(fractions):
            return "the depth images are empty; record or export them again"
        if max(fractions) < _MAX_EMPTY_FRACTION:
            return (
                f"at most {100 * max(fractions):.2g}% of the pixels have depth; record again within the range of the"
                " depth camera, or export the depth again"
            )
        measured = [frame.depth[frame.depth > 0] for frame in frames]
        near = max(float((depth < max_depth).float().mean()) for depth in measured if len(depth))
        if near < _MAX_NEAR_FRACTION:
            amount = "nearly all" if near < _MAX_EMPTY_FRACTION else "most"
            return (
                f"{amount} depth is beyond {max_depth:g} m; correct the camera's depth_scale, or raise"
                " features.max_depth"
            )
    if min(sequence.camera.width, sequence.camera.height) < _MIN_IMAGE_SIZE:
        return (
            f"images of {sequence.camera.width}x{sequence.camera.height} pixels have too few features; use images of at"
            f" least {_MIN_IMAGE_SIZE} rows and columns"
        )
    if isinstance(sequence, RGBDSequence):
        most = max(_count_features(pipeline, frame) for frame in frames)
        if most < (needed := pipeline.slam.config.mapping.min_tracked):
            return (
                f"at most {most} features of an image have depth, and a map starts with mapping.min_tracked={needed};"
                " lower it, raise features.count, or record it again with more texture in view"
            )
    has_masked_objects = torch.isin(indices, pipeline.record.objects.frames_with_masked_objects())
    if 2 * int(has_masked_objects.sum()) > len(indices):
        return f"masked objects cover the images; see {RunFile.MASKS_FIGURE}, and try --segmenter none"
    return "no features can be tracked between frames; check camera and depth, and move the camera more slowly"


def _count_features(pipeline: Pipeline, frame: RGBDFrame) -> int:
    """Count the features of a frame that have depth, also those on masked objects."""
    return int((pipeline.slam.extract_features(frame).features.depth > 0).sum())


def _cause_of_missing_scores(pipeline: Pipeline, evaluation_error: str | None) -> str | None:
    sequence = pipeline.sequence
    stored = stored_source(sequence)
    if isinstance(stored, StoredSequence) and stored.groundtruth_error is not None:
        return str(stored.groundtruth_error)
    if evaluation_error is not None and len(pipeline.slam.poses) >= MIN_PAIRS:
        return f"{sequence.name}: has no scores, {evaluation_error}"
    return None
