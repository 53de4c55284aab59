"""What the results of a run lack although the sequence came to its end: every pose, or the scores."""

from __future__ import annotations

import numpy as np

from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.evaluation import Evaluation, evaluate
from v3d_torch.evaluation.evaluation import MIN_PAIRS
from v3d_torch.pipeline import Pipeline
from v3d_torch.types import TrackingStatus

_LOOKED_AT = 5
"""Frames that stand for all."""

_PLAIN = 4.0
"""Standard deviation of an image that shows nothing, of 255: a dark one has as much of noise."""

_EMPTY = 0.01
"""Share of the pixels with depth in an image that shows nothing."""


def diagnose(pipeline: Pipeline, evaluation: Evaluation | None) -> str | None:
    """Say what is wrong with a run that no frame stopped.

    Args:
        pipeline: that has run.
        evaluation: its scores, where it has some.

    Returns:
        A sentence with the cause and the cure; None where nothing is wrong.
    """
    statuses = pipeline.slam.poses.statuses
    name = pipeline.sequence.name
    if not statuses:
        return f"{name}: gave no frame before its end; record it again"
    if all(status is TrackingStatus.LOST for status in statuses):
        return f"{name}: the camera was found in none of the {len(statuses)} frames, {_why_lost(pipeline)}"
    return pipeline.record.mask_error or _why_unscored(pipeline, evaluation)


def _why_lost(pipeline: Pipeline) -> str:
    sequence, reach = pipeline.sequence, pipeline.slam.config.features.max_depth
    if isinstance(sequence, RGBDSequence):
        indices = np.linspace(0, len(sequence) - 1, min(_LOOKED_AT, len(sequence))).astype(int)
        frames = [sequence[int(index)] for index in indices]
        if all(float(frame.image.float().std()) < _PLAIN for frame in frames):
            return "their colour is the same all over; record it again, with light and an open lens"
        if all(float((frame.depth > 0).float().mean()) < _EMPTY for frame in frames):
            return "they have no depth; record or export the depth images again"
        if all(float(((frame.depth > 0) & (frame.depth < reach)).float().mean()) < _EMPTY for frame in frames):
            return f"all depth lies beyond {reach:g} m; correct the camera's depth_scale, or raise features.max_depth"
    if pipeline.record.dynamics:
        return "people and what else may move cover them; see figures/masks.png, and try --segmenter none"
    return "nothing in them can be followed from one to the next; check camera and depth, and move more slowly"


def _why_unscored(pipeline: Pipeline, evaluation: Evaluation | None) -> str | None:
    sequence, trajectory = pipeline.sequence, pipeline.slam.poses.trajectory()
    if isinstance(sequence, StoredSequence) and sequence.groundtruth_error is not None:
        return str(sequence.groundtruth_error)
    if evaluation is None and sequence.groundtruth is not None and len(trajectory) >= MIN_PAIRS:
        try:
            evaluate(sequence.groundtruth, trajectory)
        except InputError as error:
            return f"{sequence.name}: has no scores, {error}"
    return None
