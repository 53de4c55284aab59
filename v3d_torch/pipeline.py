"""A whole sequence through the system, with the records that the results need."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from v3d_torch.datasets.base import HasMotionMasks, RGBDSequence, RGBDStream
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError, V3DError
from v3d_torch.evaluation.masks import MaskEvaluation
from v3d_torch.frame_result import FrameResult
from v3d_torch.io.files import write_png
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.mapping.tensor_table import TensorTable
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.prefetch.frame_prefetcher import FramePrefetcher
from v3d_torch.runtime.process import trim_memory
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame

_LOG = logging.getLogger(__name__)

_SNAPSHOTS = 6
"""Number of frames in the figure of masks."""

_TRIM_INTERVAL = 200
"""Frames between two calls of `trim_memory`, which takes some milliseconds."""

_MOTION_STATES = tuple(MotionState)

FrameCallback = Callable[[RGBDFrame, FrameResult], None]


class Viewer(Protocol):
    """Viewer of a run. A viewer never changes the state of the SLAM system."""

    def show(
        self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_times: Mapping[str, StageTime]
    ) -> None:
        """Show a tracked frame.

        Args:
            frame: Images of the frame.
            objects: Objects of the frame, and its static mask.
            slam: SLAM system after it tracked the frame; its last pose is the pose of the frame.
            stage_times: Time that each stage spent on the frame.
        """

    def finish(self, slam: V3DSLAM) -> None:
        """Show the final map and trajectory, and close files and connections.

        Args:
            slam: SLAM system after the last frame.

        Raises:
            OutputError: If the recording cannot be written.
        """


class NullViewer:
    """Viewer that shows nothing."""

    def show(
        self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_times: Mapping[str, StageTime]
    ) -> None:
        """Do nothing."""

    def finish(self, slam: V3DSLAM) -> None:
        """Do nothing."""


NULL_VIEWER = NullViewer()
"""Viewer of a run that is not shown."""


@dataclass(frozen=True)
class Snapshot:
    """A frame that is kept for the figures.

    Attributes:
        frame: Frame.
        T_cw: World-to-camera pose at that time, float64, shape :math:`(4, 4)`.
        result: Result of the frame, with its objects.
    """

    frame: RGBDFrame
    T_cw: Tensor
    result: FrameResult


@dataclass(frozen=True)
class FrameTimes:
    """Time spent on one frame.

    Attributes:
        frame: Index of the frame.
        stamp: Timestamp of the frame, seconds.
        stages: Time of each stage that ran.
    """

    frame: int
    stamp: float
    stages: Mapping[str, StageTime]


def _dynamics_table() -> TensorTable:
    # Tensors take a tenth of the memory of a dictionary for each row.
    return TensorTable(
        frame=((), torch.int64),
        stamp=((), torch.float64),
        id=((), torch.int64),
        label=((), torch.int64),
        centroid=((3,), torch.float64),
        votes=((), torch.int64),
        chamfer=((), torch.float64),
        motion_state=((), torch.int64),
        missed=((), torch.bool),
    )


@dataclass
class RunRecord:
    """Records of a run in addition to the trajectory.

    Attributes:
        frames: Times of each frame.
        dynamics: One row per frame and object: index and timestamp of the frame, id, COCO class, centroid (world frame,
            metres), votes, Chamfer distance, position of the motion state in `MotionState`, and whether it was missed.
        snapshots: Frames for the figure of masks.
        most_dynamic_snapshot: The frame with the most votes for dynamic objects; of several, the one with most objects.
        mask_evaluation: Comparison of the masks with true masks.
        seconds: Wall time of all frames, seconds.
        failure: Reason why the run ended before the sequence; None if it did not.
        interrupted: True if the user interrupted the run.
        mask_error: Reason why the masks were not evaluated although there are true masks; None if there is none.
        save_error: Reason why a checkpoint could not be written; None if there is none.
    """

    frames: list[FrameTimes] = field(default_factory=list)
    dynamics: TensorTable = field(default_factory=_dynamics_table)
    snapshots: list[Snapshot] = field(default_factory=list)
    most_dynamic_snapshot: Snapshot | None = None
    mask_evaluation: MaskEvaluation = field(default_factory=MaskEvaluation)
    seconds: float = 0.0
    failure: str | None = None
    interrupted: bool = False
    mask_error: str | None = None
    save_error: str | None = None

    @property
    def motion_state_counts(self) -> dict[MotionState, int]:
        """Number of rows of ``dynamics`` with each motion state, in the order of their first row."""
        codes = self.dynamics["motion_state"].tolist()
        return {_MOTION_STATES[code]: count for code, count in Counter(codes).items()}


class Pipeline:
    """Runs a sequence through the system.

    Args:
        sequence: Frames, stored or live.
        slam: System; frames of a stored sequence that it has processed already are skipped.
        masks: Folder for an image of the masked pixels per frame; None for no images.
        viewer: Viewer that is shown each frame.
        views: Views of the keyframes of a known map; None to start without views.
        evaluate_masks: True to compare the masks with true masks, if the sequence has any.

    Attributes:
        record: Records of the run.
        between_frames: False while a frame is processed, and if the processing of a frame failed.
    """

    def __init__(
        self,
        sequence: RGBDStream,
        slam: V3DSLAM,
        masks: Path | None = None,
        viewer: Viewer = NULL_VIEWER,
        views: StaticViews | None = None,
        *,
        evaluate_masks: bool = True,
    ) -> None:
        self.sequence = sequence
        self.slam = slam
        self.views = StaticViews(sequence.camera, slam.config.dense_map.stride) if views is None else views
        self.record = RunRecord()
        self.between_frames = True
        self._masks = masks
        self._viewer = viewer
        self._with_mask_evaluation = evaluate_masks
        self._snapshot_step = 1

    @property
    def frame_count(self) -> int:
        """Number of frames of the sequence; of a live stream, the number processed so far."""
        return len(self.sequence) if isinstance(self.sequence, Sized) else len(self.slam.poses)

    def __call__(self, on_frame: FrameCallback | None = None) -> RunRecord:
        """Process all frames. If a frame cannot be read or the user interrupts, the results so far are kept.

        Interrupting is the normal way to end a live stream, and is not a failure.

        Args:
            on_frame: Called after each frame.

        Returns:
            The records of the run, including those of frames before it was resumed.
        """
        record = self.record
        record.failure, record.interrupted = None, False
        previous_seconds, start = record.seconds, time.perf_counter()
        try:
            prefetcher = FramePrefetcher(self._remaining_frames(), self.slam, ahead=self.slam.config.prefetch)
            with torch.inference_mode(), closing(prefetcher):
                for preprocessed in prefetcher:
                    self.between_frames = False
                    frame, result = preprocessed.frame, self.slam.track(preprocessed)
                    times = self.slam.timer.lap()
                    record.frames.append(FrameTimes(frame.index, frame.stamp, times))
                    self._record_frame(frame, result)
                    self._viewer.show(frame, result, self.slam, times)
                    record.seconds, self.between_frames = previous_seconds + time.perf_counter() - start, True
                    if on_frame is not None:
                        on_frame(frame, result)
                    if len(record.frames) % _TRIM_INTERVAL == 0:
                        trim_memory()
        except V3DError as error:
            record.failure = str(error)
        except Exception as error:  # an error of the program must not cost the results so far
            _LOG.exception("the run failed")
            reason = (str(error).splitlines() or [""])[0]
            record.failure = f"the program failed with {type(error).__name__}: {reason}; report it with the run.log"
        except KeyboardInterrupt:
            record.interrupted = True
            if isinstance(self.sequence, Sized):
                done, total = len(self.slam.poses), len(self.sequence)
                record.failure = f"interrupted after {done} of {total} frames"
        record.seconds = previous_seconds + time.perf_counter() - start
        return record

    @torch.inference_mode()
    def flush(self) -> None:
        """Apply the pending result of the back end and show the final state; call this after the last frame."""
        self.slam.flush()
        try:
            self._viewer.finish(self.slam)
        except V3DError as error:
            self.record.failure = self.record.failure or str(error)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the run between two frames: system, records and views."""
        return {"slam": self.slam.state_dict(), "record": self.record, "views": self.views.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self.slam.load_state_dict(state["slam"])
        self.record = state["record"]
        self.views.load_state_dict(state["views"])

    def _remaining_frames(self) -> Iterator[RGBDFrame]:
        done = len(self.slam.poses) if isinstance(self.sequence, RGBDSequence) else 0
        if isinstance(self.sequence, StoredSequence):
            return self.sequence.frames_from(done)
        return islice(iter(self.sequence), done, None)

    def _record_frame(self, frame: RGBDFrame, result: FrameResult) -> None:
        _append_dynamics(self.record.dynamics, frame, result.objects)
        self._evaluate_masks(frame, result)
        if self._masks is not None:
            masked = (~result.static_mask).to(torch.uint8) * 255
            write_png(self._masks / f"{frame.stamp:.6f}.png", masked.numpy())
        keyframes = self.slam.map.keyframes
        if keyframes and keyframes[-1].frame == frame.index:
            self.views.add(keyframes[-1], frame.image, frame.depth, result.static_without_people)
        self._keep_snapshot(Snapshot(frame, self.slam.poses.T_cw, result))

    def _keep_snapshot(self, snapshot: Snapshot) -> None:
        """Keep the most dynamic frame, and frames at equal intervals, which grow with the length of a live stream."""
        best = self.record.most_dynamic_snapshot
        if best is None or _dynamic_votes(snapshot.result) > _dynamic_votes(best.result):
            self.record.most_dynamic_snapshot = snapshot
        snapshots = self.record.snapshots
        if isinstance(self.sequence, Sized):
            step = max(len(self.sequence) // _SNAPSHOTS, 1)
            wanted = snapshot.frame.index % step == step // 2 and len(snapshots) < _SNAPSHOTS
        else:
            if len(snapshots) == 2 * _SNAPSHOTS:
                del snapshots[1::2]
                self._snapshot_step *= 2
            wanted = snapshot.frame.index % self._snapshot_step == 0
        if wanted:
            snapshots.append(snapshot)

    def _evaluate_masks(self, frame: RGBDFrame, result: FrameResult) -> None:
        truth = None
        if self._with_mask_evaluation and isinstance(self.sequence, HasMotionMasks) and self.record.mask_error is None:
            try:
                truth = self.sequence.motion_mask(frame.index)
            except InputError as error:  # true masks only serve the evaluation
                self.record.mask_error = str(error)
        if truth is not None:
            masks = {each.id: each.mask for each in result.objects}
            self.record.mask_evaluation.add(frame.stamp, truth, frame.depth, ~result.static_mask, masks)


def _dynamic_votes(objects: FrameObjects) -> tuple[int, int]:
    """Return the number of votes for dynamic objects, and the number of objects."""
    dynamic = {each.id for each in objects.objects if each.motion_state is MotionState.DYNAMIC}
    return sum(candidate in dynamic for _, candidate in objects.vote_pairs), len(objects.objects)


def _append_dynamics(table: TensorTable, frame: RGBDFrame, objects: Sequence[TrackedObject]) -> None:
    if not objects:
        return
    table.append(
        frame=torch.full((len(objects),), frame.index),
        stamp=torch.full((len(objects),), frame.stamp, dtype=torch.float64),
        id=torch.tensor([each.id for each in objects]),
        label=torch.tensor([each.label for each in objects]),
        centroid=torch.stack([each.centroid for each in objects]),
        votes=torch.tensor([each.votes for each in objects]),
        chamfer=torch.tensor([each.chamfer for each in objects], dtype=torch.float64),
        motion_state=torch.tensor([_MOTION_STATES.index(each.motion_state) for each in objects]),
        missed=torch.tensor([each.missed for each in objects]),
    )
