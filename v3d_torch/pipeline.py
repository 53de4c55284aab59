"""A whole sequence through the system, with everything that the results need noted on the way."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sized
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.datasets.base import HasMotionMasks, RGBDSequence, RGBDStream
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError, V3DError
from v3d_torch.evaluation.masks import MaskEvaluation
from v3d_torch.io.files import write_png
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.prefetch.frame_prefetcher import FramePrefetcher
from v3d_torch.runtime.process import trim_memory
from v3d_torch.segmentation.coco import class_name
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus
from v3d_torch.viz.viewer import NULL_VIEWER, Viewer

_LOG = logging.getLogger(__name__)

FrameCallback = Callable[[RGBDFrame, FrameObjects, TrackingStatus], None]


@dataclass(frozen=True)
class Snapshot:
    """A frame kept for the figures: its images, its pose as it was then, and what was said of it."""

    frame: RGBDFrame
    T_cw: Tensor
    scene: FrameObjects


@dataclass
class RunRecord:
    """What a run leaves behind beside the trajectory.

    Attributes:
        frames: a row per frame: its index and stamp, and the seconds of each stage.
        dynamics: a row per frame and object, as it goes into the table of the results.
        snapshots: frames for the figure of masks.
        liveliest: the frame with the most votes for what is dynamic, of those with as many the one with most objects.
        mask_evaluation: of the frames whose true masks are known.
        seconds: wall time of the frames.
        failure: why the run ended before the sequence did; None when it did not.
        interrupted: whether the user ended it.
        unscored: why masks were not evaluated although there are true ones.
        unsaved: why what there was could not be written while the run went on.
    """

    frames: list[dict[str, float]] = field(default_factory=list)
    dynamics: list[dict[str, object]] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)
    most_dynamic_snapshot: Snapshot | None = None
    mask_evaluation: MaskEvaluation = field(default_factory=MaskEvaluation)
    seconds: float = 0.0
    failure: str | None = None
    interrupted: bool = False
    mask_error: str | None = None
    save_error: str | None = None


class Pipeline:
    """Runs a sequence through the system.

    Args:
        sequence: frames to take in, stored or as they come.
        slam: the system; of a stored sequence, the frames that it has taken in already are passed over.
        masks: folder for an image per frame of what was left out of tracking; None for none.
        viewer: looks on.
        views: of the keyframes of a known map; None for none.
        score: whether masks are compared with the true ones, where there are any.

    Attributes:
        whole: whether no frame is half taken in.
    """

    _SNAPSHOTS = 6
    _TIDY = 200  # frames: giving memory back takes some ms

    def __init__(
        self,
        sequence: RGBDStream,
        slam: V3DSLAM,
        masks: Path | None = None,
        viewer: Viewer = NULL_VIEWER,
        views: StaticViews | None = None,
        *,
        score: bool = True,
    ) -> None:
        self.sequence = sequence
        self.slam = slam
        self.views = StaticViews(sequence.camera, slam.config.dense_map.stride) if views is None else views
        self.record = RunRecord()
        self.between_frames = True
        self._masks = masks
        self._viewer = viewer
        self._score = score
        self._step = 1
        self._percepts: FramePrefetcher | None = None

    @property
    def frames(self) -> int:
        """Frames that there are to take in; of a stream, which does not know, those taken in."""
        return len(self.sequence) if isinstance(self.sequence, Sized) else len(self.slam.poses.statuses)

    def __call__(self, on_frame: FrameCallback | None = None) -> RunRecord:
        """Process all frames. What was computed is kept when a frame cannot be read or the user interrupts.

        An interrupt is how a stream without an end is meant to end, and no failure.

        Args:
            on_frame: called after each frame.
        """
        self.record.failure, self.record.interrupted = None, False
        before, start = self.record.seconds, time.perf_counter()
        try:
            # Nobody learns through a run: to keep no gradients in mind saves a tenth of the time.
            with torch.inference_mode(), closing(self.get_ready()) as percepts:
                start = time.perf_counter()
                for percept in percepts:
                    self.between_frames = False
                    frame, scene = percept.frame, self.slam.track(percept)
                    seconds = self.slam.timer.lap()
                    self.record.frames.append({"frame": frame.index, "stamp": frame.stamp, **seconds})
                    self._note(frame, scene)
                    self._viewer.show(frame, scene, self.slam, seconds)
                    self.record.seconds, self.between_frames = before + time.perf_counter() - start, True
                    if on_frame is not None:
                        on_frame(frame, scene, self.slam.poses.statuses[-1])
                    if len(self.record.frames) % self._TIDY == 0:
                        trim_memory()
        except V3DError as error:
            self.record.failure = str(error)
        except Exception as error:  # what was computed is worth keeping when the program is at fault, too
            _LOG.exception("the run broke")
            why = (str(error).splitlines() or [""])[0]
            self.record.failure = f"the program failed with {type(error).__name__}: {why}; report it with the run.log"
        except KeyboardInterrupt:
            self.record.interrupted = True
            if isinstance(self.sequence, Sized):
                done, total = len(self.slam.poses.statuses), len(self.sequence)
                self.record.failure = f"interrupted after {done} of {total} frames"
        self.record.seconds, self._percepts = before + time.perf_counter() - start, None
        return self.record

    def get_ready(self) -> FramePrefetcher:
        """What looks at the frames, begun and up, which may take seconds: a call does it first of all."""
        if self._percepts is None:
            self._percepts = FramePrefetcher(self._coming(), self.slam, ahead=self.slam.config.prefetch)
        return self._percepts

    @torch.inference_mode()
    def flush(self) -> None:
        """After the last frame: take in what is still being solved for it, and let the viewer show how all came out."""
        self.slam.flush()
        try:
            self._viewer.finish(self.slam)
        except V3DError as error:
            self.record.failure = self.record.failure or str(error)

    def _coming(self) -> Iterator[RGBDFrame]:
        done = len(self.slam.poses.statuses) if isinstance(self.sequence, RGBDSequence) else 0
        if isinstance(self.sequence, StoredSequence):
            return self.sequence.frames_from(done)
        return islice(iter(self.sequence), done, None)

    def _note(self, frame: RGBDFrame, scene: FrameObjects) -> None:
        self.record.dynamics.extend(_row(frame, judged) for judged in scene.objects)
        self._evaluate_masks(frame, scene)
        if self._masks is not None:
            left_out = (~scene.static_mask).to(torch.uint8) * 255
            write_png(self._masks / f"{frame.stamp:.6f}.png", left_out.numpy())
        keyframes = self.slam.mapper.map.keyframes
        if keyframes and keyframes[-1].frame == frame.index:
            self.views.add(keyframes[-1], frame.image, frame.depth, scene.static_without_people)
        self._keep_for_figures(Snapshot(frame, self.slam.poses.T_cw, scene))

    def _keep_for_figures(self, shot: Snapshot) -> None:
        """Keep every so manieth frame; of a stream, whose length is not known, ever fewer. And the liveliest."""
        best = self.record.most_dynamic_snapshot
        if best is None or _liveliness(shot.scene) > _liveliness(best.scene):
            self.record.most_dynamic_snapshot = shot
        snapshots = self.record.snapshots
        if isinstance(self.sequence, Sized):
            step = max(len(self.sequence) // self._SNAPSHOTS, 1)
            wanted = shot.frame.index % step == step // 2 and len(snapshots) < self._SNAPSHOTS
        else:
            if len(snapshots) == 2 * self._SNAPSHOTS:
                del snapshots[1::2]
                self._step *= 2
            wanted = shot.frame.index % self._step == 0
        if wanted:
            snapshots.append(shot)

    def _evaluate_masks(self, frame: RGBDFrame, scene: FrameObjects) -> None:
        truth = None
        if self._score and isinstance(self.sequence, HasMotionMasks) and self.record.mask_error is None:
            try:
                truth = self.sequence.motion_mask(frame.index)
            except InputError as error:  # the truth is for the scores only
                self.record.mask_error = str(error)
        if truth is not None:
            objects = {judged.id: judged.mask for judged in scene.objects}
            self.record.mask_evaluation.add(frame.stamp, truth, frame.depth, ~scene.static_mask, objects)


def _liveliness(scene: FrameObjects) -> tuple[int, int]:
    dynamic = {judged.id for judged in scene.objects if judged.motion_state is MotionState.DYNAMIC}
    return sum(elected in dynamic for _, elected in scene.vote_pairs), len(scene.objects)


def _row(frame: RGBDFrame, judged: TrackedObject) -> dict[str, object]:
    x, y, z = judged.centroid.tolist()
    return {
        "frame": frame.index,
        "stamp": frame.stamp,
        "id": judged.id,
        "class": class_name(judged.label),
        "x": x,
        "y": y,
        "z": z,
        "votes": judged.votes,
        "chamfer": judged.chamfer,
        "motion_state": judged.motion_state.value,
        "missed": judged.missed,
    }
