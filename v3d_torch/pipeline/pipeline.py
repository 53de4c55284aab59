"""Pipeline: runs a whole sequence through `V3DSLAM`, with records and a viewer."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sized
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from v3d_torch.calibration.colour_order import check_colour_order
from v3d_torch.calibration.exposure import check_exposure
from v3d_torch.calibration.lens import check_lens
from v3d_torch.calibration.people_size import apparent_sizes
from v3d_torch.calibration.plausibility import check_plausibility
from v3d_torch.datasets.base import HasMotionMasks, LiveStream, RGBDSequence, RGBDStream
from v3d_torch.datasets.readable_frames import ReadableFrames
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError, StageError, V3DError
from v3d_torch.frame_result import FrameResult
from v3d_torch.io.files import write_png
from v3d_torch.io.text import first_line
from v3d_torch.io.timestamps import format_timestamp
from v3d_torch.live.live_slam import LiveResult, LiveSLAM
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.objects.frame_objects import FrameObjects, MotionState
from v3d_torch.pipeline.frame_prefetcher import FramePrefetcher
from v3d_torch.pipeline.run_record import RunRecord, Snapshot
from v3d_torch.pipeline.viewer import Viewer, ViewerGroup
from v3d_torch.reconstruction.point_map import PointMap, fuse_points
from v3d_torch.runtime.process import trim_memory, trim_memory_at_intervals
from v3d_torch.runtime.stopwatch import Stopwatch
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus

_LOG = logging.getLogger(__name__)

_SNAPSHOTS = 6
"""Number of frames in the figure of masks."""

_CHECKED_KEYFRAMES = 15
"""Number of keyframes after which camera and depth are checked once: some seconds of a moving camera. Shorter runs and
live runs are checked at their end; a check takes a second, or some seconds if it finds an error."""

FrameCallback = Callable[[RGBDFrame, FrameResult], None]


class Pipeline:
    """Runs a sequence through the system.

    Args:
        sequence: Frames, stored or live.
        slam: System; frames of a stored sequence that it has already processed are skipped.
        masks: Folder for an image per frame of the pixels that tracking excludes; None for no images.
        map_masks: Folder for an image per frame of the pixels that maps exclude: those of `masks`, and all people; None
            for no images.
        viewer: Viewer that shows each frame; None for no viewer.
        views: Views of the keyframes of a known map; None to start without views.
        evaluate_masks: True to compare the masks with true masks, if the sequence has any.
        skip_broken: True to skip broken frames of a stored sequence, see `ReadableFrames`.

    Attributes:
        record: Records of the run.
        between_frames: False while a frame is processed, and if the processing of a frame of a sequence failed. A live
            stream cannot be resumed, so that it has no meaning there.

    Raises:
        ConfigError: If the sequence is live, and the configuration does not allow threads.
    """

    def __init__(
        self,
        sequence: RGBDStream,
        slam: V3DSLAM,
        masks: Path | None = None,
        viewer: Viewer | None = None,
        views: StaticViews | None = None,
        *,
        map_masks: Path | None = None,
        evaluate_masks: bool = True,
        skip_broken: bool = False,
    ) -> None:
        self.sequence = sequence
        self.slam = slam
        self.views = StaticViews(sequence.camera, slam.config.dense_map.stride) if views is None else views
        self.record = RunRecord()
        self.between_frames = True
        self._mask_folders = masks, map_masks
        self._live = LiveSLAM(sequence, slam) if isinstance(sequence, LiveStream) else None
        self._viewer = ViewerGroup(()) if viewer is None else viewer
        self._with_mask_evaluation = evaluate_masks
        self._skip_broken = skip_broken
        self._snapshot_step = 1
        self._stopwatch = Stopwatch()

    @property
    def frame_count(self) -> int:
        """Number of frames of the sequence; of a stream, the number so far, including dropped frames."""
        so_far = len(self.slam.poses) + self.record.live.dropped
        return len(self.sequence) if isinstance(self.sequence, Sized) else so_far

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
        previous_seconds, self._stopwatch = record.seconds, Stopwatch()
        try:
            tracked = self._track_frames() if self._live is None else self._track_live(self._live)
            with torch.inference_mode(), closing(tracked):
                for frame, result in tracked:
                    self._record_frame(frame, result)
                    self._viewer.show(frame, result, self.slam, self.slam.timer.lap_times)
                    record.times.append(frame, self.slam.timer.lap())
                    record.seconds, self.between_frames = previous_seconds + self._stopwatch.seconds, True
                    if on_frame is not None:
                        on_frame(frame, result)
        except StageError as error:  # the log has the traceback of the stage
            _LOG.exception("the run failed")
            record.failure = str(error)
        except V3DError as error:
            record.failure = str(error)
        except Exception as error:  # keep the results so far after an error of the program
            _LOG.exception("the run failed")
            kind, reason = type(error).__name__, first_line(error)
            cause = kind if reason == kind else f"{kind}: {reason}"
            record.failure = f"the program failed with {cause}; report it with the run.log"
        except KeyboardInterrupt:
            record.interrupted = True
            if isinstance(self.sequence, Sized):
                done, total = len(self.slam.poses), len(self.sequence)
                record.failure = f"interrupted after {done} of {total} frames"
        record.seconds = previous_seconds + self._stopwatch.seconds
        return record

    @torch.inference_mode()
    def flush(self) -> None:
        """Apply the pending results of the back end, so that all poses are final, and check camera and images.

        Call this after the last frame.
        """
        trim_memory()  # so that results do not add to memory that tracking no longer needs
        self.slam.flush()
        if not self.record.was_checked:
            self._check_plausibility()
        self.warn(check_lens(self.slam.camera))
        self.warn([*check_exposure(self.views), *check_colour_order(self.views, self.slam.segment)])
        frames = len(self.slam.poses)
        self.warn(self.record.repeated.check(frames))
        self.warn(self.record.repeated_depth.check(frames, "depth images"))
        if self.slam.occupancy is not None:
            self.slam.occupancy.correct(self.slam.poses)
        disconnected = self.slam.poses.statuses.count(TrackingStatus.DISCONNECTED)
        if disconnected:
            self.warn(
                [
                    f"{disconnected} of {frames} frames belong to a part of the map whose place is only a"
                    " guess: point map and mesh leave it out; return to a known place to join the parts"
                ]
            )

    @torch.inference_mode()
    def fuse_points(self) -> PointMap:
        """Fuse the point map, which takes much time and memory, and show the final state; call `flush` before.

        Returns:
            Point map of the static scene, fused from the views whose place in the map is known.
        """
        point_map = fuse_points(self.views.connected(), self.slam.config)
        try:
            self._viewer.finish(self.slam, point_map)
        except V3DError as error:
            _LOG.error(error)
            self.record.add_failure(str(error))
        return point_map

    def warn(self, warnings: Iterable[str]) -> None:
        """Log and record warnings that are not recorded yet; a resumed run may have recorded them already."""
        for warning in warnings:
            if warning not in self.record.warnings:
                _LOG.warning(warning)
                self.record.warnings.append(warning)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the run between two frames: system, records and views."""
        return {"slam": self.slam.state_dict(), "record": self.record, "views": self.views.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self.slam.load_state_dict(state["slam"])
        self.record = state["record"]
        self.views.load_state_dict(state["views"])

    def _track_frames(self) -> Generator[tuple[RGBDFrame, FrameResult], None, None]:
        """Track the frames of a sequence, and yield each with its result."""
        frames = self._remaining_frames()
        with closing(FramePrefetcher(frames, self.slam, ahead=self.slam.config.prefetch)) as prefetcher:
            for preprocessed in prefetcher:
                self._record_broken(frames, before=preprocessed.frame.index)
                self.between_frames = False
                yield preprocessed.frame, self.slam.track(preprocessed)
                trim_memory_at_intervals(len(self.slam.poses))
        self._record_broken(frames, before=math.inf)

    def _track_live(self, live: LiveSLAM) -> Generator[tuple[RGBDFrame, FrameResult], None, None]:
        """Track the frames of a live stream, and yield each with its result."""
        try:
            with closing(iter(live)) as results:
                for result in results:
                    self.between_frames = False
                    self.record.rejected = live.rejected
                    yield result.frame, result
        finally:
            self.record.rejected = live.rejected  # also if no frame was tracked after the last rejected one

    def _remaining_frames(self) -> Iterator[RGBDFrame]:
        """Iterate over the frames that are later than the last tracked one."""
        if not isinstance(self.sequence, RGBDSequence):
            return iter(self.sequence)
        start, total = int((self.sequence.stamps <= self.slam.poses.stamp).sum()), len(self.sequence)
        if isinstance(self.sequence, StoredSequence):
            frames = self.sequence.frames_from(start)
        else:
            frames = map(self.sequence.__getitem__, range(start, total))
        if not self._skip_broken:
            return frames
        return ReadableFrames(frames, start, total, len(self.record.broken))

    def _record_broken(self, frames: Iterator[RGBDFrame], before: float) -> None:
        """Record the broken frames before a frame, given by its index; the reader can be some frames ahead."""
        while isinstance(frames, ReadableFrames) and frames.broken and frames.broken[0].index < before:
            self.record.broken.append(frames.broken.popleft())

    def _record_frame(self, frame: RGBDFrame, result: FrameResult) -> None:
        self.record.repeated.add(frame.image)
        self.record.repeated_depth.add(frame.depth)
        self.record.states.append_state(result)
        if isinstance(result, LiveResult):
            self.record.live.append_result(result)
        self.record.objects.append_objects(frame, result, self.slam.up)
        with self._stopwatch.paused():  # the frame rate is that of the system, without the evaluation
            self._evaluate_masks(frame, result)
        for folder, mask in zip(self._mask_folders, (result.static_mask, result.map_mask), strict=True):
            if folder is not None:
                write_png(folder / f"{format_timestamp(frame.stamp)}.png", (~mask).to(torch.uint8).numpy() * 255)
        keyframe = self.slam.map.newest_keyframe_at(frame.stamp)
        if keyframe is not None:
            self.views.add(keyframe, frame.image, frame.depth, result.map_mask, frame.depth_delay, result.T_dc)
            if not self.record.was_checked:
                self.record.people_sizes += apparent_sizes(result.objects, frame.depth, self.slam.camera)
            is_due = self._live is None and not self.record.was_checked
            if is_due and len(self.views.own) >= _CHECKED_KEYFRAMES:
                with self.slam.timer("plausibility"):
                    self._check_plausibility()
        self._keep_snapshot(Snapshot(frame, self.slam.poses.T_cw, result))

    def _check_plausibility(self) -> None:
        """Check whether camera and depth agree with the map so far, and record contradictions."""
        slam, sizes = self.slam, self.record.people_sizes
        self.warn(check_plausibility(slam.map, self.views, sizes, slam.poses.trajectory(), slam.camera, slam.config))
        self.record.was_checked = True

    def _keep_snapshot(self, snapshot: Snapshot) -> None:
        """Keep the frame with the most dynamic votes, and frames at equal intervals, which increase in a live stream.

        Intervals are numbers of tracked frames, because a live stream drops frames irregularly.
        """
        best = self.record.most_dynamic_snapshot
        if best is None or _dynamic_votes(snapshot.result) > _dynamic_votes(best.result):
            self.record.most_dynamic_snapshot = snapshot
        snapshots, number = self.record.snapshots, len(self.slam.poses) - 1
        if isinstance(self.sequence, Sized):
            step = max(len(self.sequence) // _SNAPSHOTS, 1)
            wanted = number % step == step // 2 and len(snapshots) < _SNAPSHOTS
        else:
            if len(snapshots) == 2 * _SNAPSHOTS:
                del snapshots[1::2]
                self._snapshot_step *= 2
            wanted = number % self._snapshot_step == 0
        if wanted:
            snapshots.append(snapshot)

    def _evaluate_masks(self, frame: RGBDFrame, result: FrameResult) -> None:
        truth = None
        if self._with_mask_evaluation and isinstance(self.sequence, HasMotionMasks) and self.record.mask_error is None:
            try:
                truth = self.sequence.motion_mask(frame.index)
            except InputError as error:  # only the evaluation needs true masks
                self.record.mask_error = str(error)
        if truth is not None:
            masks = {each.id: each.mask for each in result.objects}
            self.record.mask_evaluation.add(frame.stamp, truth, frame.depth, ~result.static_mask, masks)


def _dynamic_votes(objects: FrameObjects) -> tuple[int, int]:
    """Return the number of votes for dynamic objects, and the number of objects."""
    dynamic = {each.id for each in objects.objects if each.motion_state is MotionState.DYNAMIC}
    return sum(candidate in dynamic for _, candidate in objects.vote_pairs), len(objects.objects)
