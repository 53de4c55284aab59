"""Checkpoints: the state of a run of a stored sequence, from which it is resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError

from v3d_torch.datasets import RGBDSequence, RGBDStream
from v3d_torch.datasets.readable_frames import BrokenFrame
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.evaluation.masks import MaskEvaluation
from v3d_torch.frame_result import FrameResult
from v3d_torch.io.files import file_size
from v3d_torch.io.state_file import read_state, write_state
from v3d_torch.mapping.static_views import StaticView
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.pipeline import Pipeline
from v3d_torch.pipeline.repeated_images import RepeatedImages
from v3d_torch.pipeline.run_record import FrameTimes, LiveTable, ObjectTable, RunRecord, Snapshot, StateTable
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.metrics_file import read_metrics, suggest_folder
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.segmentation_files import SegmentationFiles
from v3d_torch.runs.state import STATE_CLASSES

_CLASSES = (
    *STATE_CLASSES,
    RunRecord,
    BrokenFrame,
    FrameTimes,
    LiveTable,
    RepeatedImages,
    ObjectTable,
    StateTable,
    Snapshot,
    FrameObjects,
    FrameResult,
    TrackedObject,
    MotionState,
    MaskEvaluation,
    StaticView,
    set,
)
"""Classes that a checkpoint can contain."""


@dataclass(frozen=True)
class Checkpoint:
    """State of a run between two frames.

    Attributes:
        folder: Folder of the results of the run.
        request: Request of the run.
        sequence: Fingerprint of the processed part of the sequence, see `_fingerprint`.
        frames: Number of frames processed.
        state: State of the pipeline.
        segmentation: Fingerprint of the files of the segmenter, see `SegmentationFiles`.
    """

    folder: Path
    request: RunRequest
    sequence: Mapping[str, Any]
    frames: int
    state: Mapping[str, Any]
    segmentation: Mapping[str, Any]


class FileSizes:
    """Sizes of the image files of a sequence, each read once: runs can have 100,000 frames on a network drive.

    Args:
        sequence: Sequence; only an `RGBDSequence` can have image files.
    """

    def __init__(self, sequence: RGBDStream) -> None:
        self._sequence = sequence
        self._sizes: list[list[int | None]] = []

    def of_frames(self, frames: int) -> list[list[int | None]]:
        """Return the sizes of the files of each of the first frames, bytes; None for a file that cannot be read."""
        if not isinstance(self._sequence, RGBDSequence):
            return []
        for index in range(len(self._sizes), min(frames, len(self._sequence))):
            self._sizes.append([file_size(file) for file in _files(self._sequence, index)])
        return self._sizes[:frames]


def write_checkpoint(
    folder: Path, pipeline: Pipeline, request: RunRequest, sizes: FileSizes, segmentation: SegmentationFiles
) -> None:
    """Write the state of a run to its folder.

    A live stream cannot be resumed, because its frames are gone; its checkpoint contains only the request.

    Args:
        folder: Folder of the results.
        pipeline: Pipeline between two frames, after at least one frame.
        request: Request of the run.
        sizes: Sizes of the image files of the sequence of the pipeline.
        segmentation: Files of the segmenter of the pipeline.

    Raises:
        OutputError: If the file cannot be written; the previous checkpoint stays.
    """
    sequence = pipeline.sequence
    metadata: dict[str, Any] = {"request": request.absolute().to_dict()}
    state: dict[str, Any] = {}
    if isinstance(sequence, RGBDSequence):
        done = int(pipeline.record.times.indices[-1]) + 1
        metadata |= {"sequence": _fingerprint(sequence, done, sizes), "frames": len(pipeline.slam.poses)}
        metadata["segmentation"] = segmentation.fingerprint(done)
        state = pipeline.state_dict()
    write_state(folder / RunFile.CHECKPOINT, metadata, state, _CLASSES)


def is_finished(folder: Path) -> bool:
    """Check whether the run in a folder reached the end of its sequence and wrote its results.

    Raises:
        InputError: If its ``metrics.json`` is damaged, or that of a live run, whose frames are gone.
    """
    path = folder / RunFile.METRICS
    if not path.is_file():
        return False
    metrics = read_metrics(path)
    if metrics.latency is not None:
        raise InputError(f"{folder}: a live run cannot be resumed; its results are in this folder")
    return metrics.failure is None


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read the checkpoint of a run that ended early.

    Raises:
        InputError: If there is no checkpoint, or if it is damaged, from another version or of a live stream.
    """
    path = folder / RunFile.CHECKPOINT
    if not path.is_file():
        cause = "has no checkpoint" if folder.is_dir() else "is not a folder"
        fix = suggest_folder(folder, RunFile.CHECKPOINT) or (
            "pass the folder of a run that ended early, or run the sequence again"
        )
        raise InputError(f"{folder}: {cause}; {fix}")
    metadata, state = read_state(path, _CLASSES)
    try:
        request = RunRequest.from_dict(metadata["request"])
        if "sequence" not in metadata:
            raise InputError(
                f"{folder}: the run of a live stream ({request.seq}) cannot be resumed; its results so far are in"
                " trajectory.txt"
            )
        sequence, frames, segmentation = (metadata[name] for name in ("sequence", "frames", "segmentation"))
        return Checkpoint(folder, request, sequence, frames, state, segmentation)
    except (ValidationError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: is not the checkpoint of a run; run the sequence again") from error


def describe_change(checkpoint: Checkpoint, sequence: RGBDStream) -> str | None:
    """Describe a change in the part of a sequence that a checkpoint has processed; None if there is no change.

    The timestamps and the sizes of all image files of that part are compared, and the images of the last processed
    frame. Later frames can have been removed, added or replaced. The ground truth is not compared, because it is only
    used at the end.

    Raises:
        InputError: If the last processed frame cannot be read.
    """
    if not isinstance(sequence, RGBDSequence):
        return "it is a live stream"
    last = checkpoint.state["slam"]["previous"].frame
    stored, current = checkpoint.sequence, _fingerprint(sequence, last.index + 1, FileSizes(sequence))
    if stored["camera"] != current["camera"]:
        return "another camera"
    for before, now in zip_longest(stored["stamps"], current["stamps"]):
        if before != now:
            is_added = before in sequence.stamps.tolist()  # frames that were added can have moved it beyond the part
            return f"the frame at {now:.6f} s is new" if is_added else f"the frame at {before:.6f} s is missing"
    broken = {frame.index for frame in checkpoint.state["record"].broken}
    for index, (sizes, current_sizes) in enumerate(zip(stored["sizes"], current["sizes"], strict=True)):
        for file, before, now in zip(_files(sequence, index), sizes, current_sizes, strict=False):
            if before != now and index not in broken:
                return f"{file} has changed"
    frame = sequence[last.index]
    same = torch.equal(frame.image, last.image) and torch.equal(frame.depth, last.depth)
    return None if same else f"frame {last.index} shows another image"


def _fingerprint(sequence: RGBDSequence, frames: int, sizes: FileSizes) -> dict[str, Any]:
    """Return plain values that distinguish the first frames of a sequence from others without reading its images."""
    camera = json.loads(json.dumps(asdict(sequence.camera)))
    return {"camera": camera, "stamps": sequence.stamps[:frames].tolist(), "sizes": sizes.of_frames(frames)}


def _files(sequence: RGBDSequence, index: int) -> tuple[Path, ...]:
    return sequence.files(index) if isinstance(sequence, StoredSequence) else ()
