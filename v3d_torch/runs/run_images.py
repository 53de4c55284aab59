"""Images of a finished run with their poses and masks, for exports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import torch
from torch import Tensor

from v3d_torch.datasets import RGBDSequence, RGBDStream
from v3d_torch.datasets.locate import is_live
from v3d_torch.datasets.sequence_digest import sequence_digest
from v3d_torch.errors import InputError
from v3d_torch.export.posed_image import PosedImage
from v3d_torch.io.download import Progress
from v3d_torch.io.image_file import read_image
from v3d_torch.io.timestamps import format_timestamp
from v3d_torch.runs.file_names import MAP_MASKS
from v3d_torch.runs.request import RunRequest, check_not_moved
from v3d_torch.runs.stored_run import StoredRun
from v3d_torch.types import RGBDFrame, Trajectory

_STAMP_TOLERANCE = 2e-6
"""Tolerance of timestamps, seconds: files have six decimals."""


def open_images(run: StoredRun, request: RunRequest, progress: Progress | None) -> RGBDStream:
    """Open the source of the images of a run again.

    Args:
        run: Results of the run.
        request: Options of the run.
        progress: Callback for the progress of slow sources; None for no reports.

    Raises:
        InputError: If the source is a live camera, was moved, or cannot be opened.
        DownloadError: If the source is missing and cannot be downloaded.
    """
    if is_live(request.seq):
        raise InputError(
            f"{run.folder}: the images of a live camera are not stored; record them first with v3d-torch record, and"
            " run the recording"
        )
    check_not_moved(request, run.folder)
    return request.open_source(progress)


def note_other_name(run: StoredRun, source: RGBDStream) -> str | None:
    """Return a sentence on a source that has another name than the sequence of the run; None if the names are equal.

    Timestamps alone do not distinguish sequences: those of many data sets are multiples of the frame interval.

    Raises:
        InputError: If the source also has another camera, other timestamps or another ground truth.
    """
    name, digest = run.metrics.sequence, run.metrics.sequence_digest
    if source.name == name:
        return None
    if digest is not None and isinstance(source, RGBDSequence) and sequence_digest(source) != digest:
        raise InputError(
            f"{source.name}: is another sequence than {name} of the run in {run.folder} (camera, timestamps or ground"
            " truth differ); pass the sequence of this run with --seq"
        )
    return f"the run was of {name}; check that {source.name} has the same images"


@dataclass(frozen=True)
class LocalisedFrames:
    """Frames of a run with a known pose.

    Attributes:
        indices: Positions in the source, increasing.
        poses: Poses of the frames.
    """

    indices: list[int]
    poses: Trajectory

    def __len__(self) -> int:
        return len(self.indices)

    def every(self, step: int) -> LocalisedFrames:
        """Return every n-th frame."""
        return LocalisedFrames(self.indices[::step], self.poses.select(slice(None, None, step)))


def localised_frames(run: StoredRun, *, only_keyframes: bool = False) -> LocalisedFrames:
    """Select the frames whose pose is known relative to the whole map.

    Args:
        run: Results of the run.
        only_keyframes: True for the keyframes among them.

    Raises:
        InputError: If there is no such frame.
    """
    table = [] if run.frames is None else run.frames.select(["frame", "keyframe"]).to_pylist()
    # Broken frames have no row and no pose.
    rows = [position for position, status in enumerate(run.metrics.status[: len(table)]) if status.is_localised]
    if not rows or run.trajectory is None:
        raise InputError(f"{run.folder}: has no frame with a known pose; run another sequence")
    if only_keyframes:
        rows = [position for position in rows if table[position]["keyframe"]]
    if not rows:  # a run with --localise makes no keyframes
        raise InputError(f"{run.folder}: has no keyframe with a known pose; export without --keyframes")
    return LocalisedFrames([table[position]["frame"] for position in rows], run.trajectory.select(rows))


def posed_images(
    run: StoredRun, source: RGBDStream, frames: LocalisedFrames, *, masks: bool, masks_needed: bool = False
) -> Iterator[PosedImage]:
    """Read frames with their poses and masks, one after the other.

    Args:
        run: Results of the run.
        source: Images of the run.
        frames: Frames to read.
        masks: True to read the masks that the run saved; False for masks that exclude nothing.
        masks_needed: True if the masks cannot be left out, for the error message.

    Returns:
        Iterator over the frames, which raises an InputError if an image cannot be read or is not from the run.

    Raises:
        InputError: If the run saved no masks, or the source has fewer frames than the run had.
    """
    folder = run.folder / MAP_MASKS
    if masks and not folder.is_dir():
        alternative = "" if masks_needed else ", or do not mask with --no-masks"
        raise InputError(f"{run.folder}: has no masks; run the sequence again with --save-masks{alternative}")
    if isinstance(source, RGBDSequence) and frames.indices[-1] >= len(source):
        raise InputError(
            f"{source.name}: has {len(source)} frames, fewer than the run; pass the sequence of this run with --seq"
        )
    return _read_images(run, source, frames, folder if masks else None)


def _read_images(
    run: StoredRun, source: RGBDStream, frames: LocalisedFrames, masks: Path | None
) -> Iterator[PosedImage]:
    images = _read_frames(source, frames.indices)
    for frame, stamp, T_wc in zip(images, frames.poses.stamps.tolist(), frames.poses.T_wc, strict=False):
        if abs(frame.stamp - stamp) > _STAMP_TOLERANCE:
            raise InputError(
                f"{source.name}: frame {frame.index} is at {frame.stamp:.6f} s, but at {stamp:.6f} s in {run.folder};"
                " pass the sequence of this run with --seq"
            )
        size = frame.depth.shape[1:]
        static = (
            torch.ones(size, dtype=torch.bool)
            if masks is None
            else _read_mask(masks / f"{format_timestamp(stamp)}.png", size)
        )
        yield PosedImage(frame, T_wc, static)


def _read_frames(source: RGBDStream, indices: Sequence[int]) -> Iterator[RGBDFrame]:
    if isinstance(source, RGBDSequence):
        return map(source.__getitem__, indices)
    wanted = set(indices)
    return (frame for frame in islice(source, indices[-1] + 1) if frame.index in wanted)


def _read_mask(path: Path, size: torch.Size) -> Tensor:
    """Read the static pixels of a frame, bool, shape (H, W)."""
    mask = read_image(path, cv2.IMREAD_GRAYSCALE)
    if mask is None or mask.shape != size:
        raise InputError(f"{path}: is missing, damaged or of another size; run the sequence again with --save-masks")
    return torch.from_numpy(mask == 0)
