"""Checkpoints: all that a run of a stored sequence needs to go on where it was killed, in one file in its folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from v3d_torch.config import Config
from v3d_torch.datasets import RGBDSequence, RGBDStream
from v3d_torch.errors import InputError
from v3d_torch.evaluation.masks import MaskEvaluation
from v3d_torch.frame_result import FrameResult
from v3d_torch.io.state_file import read_state, write_state
from v3d_torch.mapping.static_views import StaticView
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.pipeline import Pipeline, RunRecord, Snapshot
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.state import CLASSES, OF_SLAM, State, gather, put_back, refresh
from v3d_torch.runs.stored_run import read_metrics, suggest_folder

CHECKPOINT = "checkpoint.v3d"
"""Name of the file. It is there from a run's first checkpoint to its end."""

_OF_RUN = ("run", "views._views", *(f"slam.{name}" for name in OF_SLAM))
"""Attributes of `Pipeline`."""

_CLASSES = (
    *CLASSES,
    RunRecord,
    Snapshot,
    FrameObjects,
    FrameResult,
    TrackedObject,
    MotionState,
    MaskEvaluation,
    StaticView,
)


@dataclass(frozen=True)
class Checkpoint:
    """A run as it was between two frames.

    Attributes:
        folder: of its results.
        request: what was asked of it.
        config: of the system.
        sequence: what it was like, see `_likeness`.
        frames: that it had taken in.
        state: of the pipeline.
    """

    folder: Path
    request: RunRequest
    config: Config
    sequence: Mapping[str, Any]
    frames: int
    state: State


def write_checkpoint(folder: Path, pipeline: Pipeline, request: RunRequest) -> None:
    """Write all that a run has so far. Of a stream, whose frames do not come again, only that there was one.

    Args:
        folder: of its results.
        pipeline: between two frames, of which it has taken in at least one.
        request: what was asked of it.

    Raises:
        OutputError: when the file cannot be written; the one before stays.
    """
    sequence = pipeline.sequence
    about: dict[str, Any] = {
        "request": asdict(request.absolute()),
        "config": pipeline.slam.config.model_dump(mode="json"),
    }
    state: State = {}
    if isinstance(sequence, RGBDSequence):
        about |= {"sequence": _likeness(sequence), "frames": len(pipeline.slam.poses.statuses)}
        state = gather(pipeline, _OF_RUN)
    write_state(folder / CHECKPOINT, about, state)


def is_finished(folder: Path) -> bool:
    """Whether the run in a folder came to the end of its sequence, and wrote its results.

    Raises:
        InputError: its ``metrics.json`` is broken.
    """
    path = folder / "metrics.json"
    return path.is_file() and read_metrics(path).failure is None


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read how far a run has come that did not come to its end.

    Raises:
        InputError: there is no checkpoint, or it is damaged, of another version or of a stream.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        lacks = "has no checkpoint to go on from" if folder.is_dir() else "is no folder"
        instead = suggest_folder(folder, CHECKPOINT) or (
            "give the folder of a run that was killed after its first one, or run the sequence again"
        )
        raise InputError(f"{folder}: {lacks}; {instead}")
    about, state = read_state(path, _CLASSES)
    try:
        request, config = RunRequest(**about["request"]), Config.model_validate(about["config"])
        if "sequence" not in about:
            raise InputError(
                f"{folder}: is the run of a stream ({request.seq}), whose frames do not come again, and cannot be"
                " gone on with; what it found is in its trajectory.txt"
            )
        if state.keys() != set(_OF_RUN):
            raise ValueError
        return Checkpoint(folder, request, config, about["sequence"], about["frames"], state)
    except (ValidationError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: is the state of something else than a run; run the sequence again") from error


def describe_change(checkpoint: Checkpoint, sequence: RGBDStream) -> str | None:
    """How a sequence differs from the one that the frames of a checkpoint were of, in words; None where it does not.

    Frames are not compared, but for the last one: nor is the ground truth, which is looked at in the end only.

    Raises:
        InputError: that frame cannot be read.
    """
    if not isinstance(sequence, RGBDSequence):
        return "it is a stream"
    then, now = checkpoint.sequence, _likeness(sequence)
    said = {
        "frames": f"it has {now['frames']} frames and had {then['frames']}",
        "times": "its frames have other times",
        "camera": "its camera is another",
    }
    for key, what in said.items():
        if then[key] != now[key]:
            return what
    last = checkpoint.state["slam._last"].frame
    again = sequence[last.index]
    same = torch.equal(again.image, last.image) and torch.equal(again.depth, last.depth)
    return None if same else f"frame {last.index} shows something else"


def restore(pipeline: Pipeline, checkpoint: Checkpoint) -> None:
    """Let a new pipeline be as the one was that wrote a checkpoint: called, it takes in the frames that are left.

    Args:
        pipeline: of the same sequence and configuration.
        checkpoint: see `read_checkpoint`.
    """
    put_back(pipeline, checkpoint.state)
    refresh(pipeline.slam)


def _likeness(sequence: RGBDSequence) -> dict[str, Any]:
    """What tells a sequence from another at little cost, in plain values."""
    stamps = hashlib.sha256(sequence.stamps.numpy().tobytes()).hexdigest()
    likeness = {"frames": len(sequence), "times": stamps, "camera": asdict(sequence.camera)}
    return json.loads(json.dumps(likeness))
