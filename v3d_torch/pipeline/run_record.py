"""Records of a run from which the results are written, in addition to the trajectory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from v3d_torch.datasets.readable_frames import BrokenFrame
from v3d_torch.evaluation.masks import MaskEvaluation
from v3d_torch.frame_result import FrameResult
from v3d_torch.live.live_slam import LiveResult
from v3d_torch.objects.frame_objects import FrameObjects, MotionState
from v3d_torch.objects.upright_box import UprightBox
from v3d_torch.pipeline.repeated_images import RepeatedImages
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.runtime.tensor_table import TensorTable
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.types import TRACKING_STATUSES, RGBDFrame, TrackingStatus

_MOTION_STATES = tuple(MotionState)


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


class FrameTimes:
    """Time spent on each frame, by stage. A frame takes half a kilobyte, because runs can have 100,000 of them.

    Attributes:
        stages: Names of the stages, in the order in which they first ran.
    """

    def __init__(self) -> None:
        self.stages: list[str] = []
        self._frames = TensorTable(index=((), torch.int64), stamp=((), torch.float64))
        self._times = TensorTable(row=((), torch.int64), stage=((), torch.int64), seconds=((2,), torch.float64))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._frames)

    @property
    def indices(self) -> Tensor:
        """Index of each frame in the sequence, int64, shape :math:`(N,)`."""
        return self._frames["index"]

    @property
    def stamps(self) -> Tensor:
        """Timestamps of the frames, seconds, float64, shape :math:`(N,)`."""
        return self._frames["stamp"]

    @property
    def wall(self) -> Tensor:
        """Wall time of each stage, seconds, float64, shape :math:`(N, S)`; 0 for stages that did not run."""
        return self._seconds()[..., 0]

    @property
    def cpu(self) -> Tensor:
        """Processor time of each stage, seconds, float64, shape :math:`(N, S)`; 0 for stages that did not run."""
        return self._seconds()[..., 1]

    def append(self, frame: RGBDFrame, times: Mapping[str, StageTime]) -> None:
        """Append a frame with the time of each stage that ran."""
        self.stages += [stage for stage in times if stage not in self.stages]
        self._times.append(
            row=torch.full((len(times),), len(self)),
            stage=torch.tensor([self.stages.index(stage) for stage in times], dtype=torch.int64),
            seconds=torch.tensor(list(times.values()), dtype=torch.float64).reshape(-1, 2),
        )
        self._frames.append(index=torch.tensor([frame.index]), stamp=torch.tensor([frame.stamp], dtype=torch.float64))

    def _seconds(self) -> Tensor:
        seconds = torch.zeros(len(self), len(self.stages), 2, dtype=torch.float64)
        seconds[self._times["row"], self._times["stage"]] = self._times["seconds"]
        return seconds


class ObjectTable(TensorTable):
    """Objects of all frames, one row per frame and object.

    The columns are the index and timestamp of the frame, and id, COCO class, centroid and velocity (world frame, metres
    and seconds) with the standard deviation of each coordinate, upright box (centre, size, yaw), votes, change of shape
    (``chamfer`` of `TrackedObject`), position of the motion state in `MotionState`, and true if the network missed the
    object. Centroid, velocity, standard deviations and box are NaN until the object has a centroid.
    """

    def __init__(self) -> None:
        super().__init__(
            frame=((), torch.int64),
            stamp=((), torch.float64),
            id=((), torch.int64),
            label=((), torch.int64),
            centroid=((3,), torch.float64),
            velocity=((3,), torch.float64),
            sigmas=((2,), torch.float64),
            box=((7,), torch.float64),
            votes=((), torch.int64),
            chamfer=((), torch.float64),
            motion_state=((), torch.int64),
            missed=((), torch.bool),
        )

    def append_objects(self, frame: RGBDFrame, found: FrameObjects, up: Tensor) -> None:
        """Append the objects of a frame; `up` is the direction against gravity in the world frame, shape (3,)."""
        objects = found.objects
        if not objects:
            return
        boxes = found.boxes(up)
        velocity = torch.stack([each.state.velocity for each in objects])
        velocity[[not each.state.is_known for each in objects]] = torch.nan
        self.append(
            frame=torch.full((len(objects),), frame.index),
            stamp=torch.full((len(objects),), frame.stamp, dtype=torch.float64),
            id=torch.tensor([each.id for each in objects]),
            label=torch.tensor([each.label for each in objects]),
            centroid=torch.stack([each.centroid for each in objects]),
            velocity=velocity,
            sigmas=torch.tensor([each.state.sigmas for each in objects], dtype=torch.float64),
            box=torch.tensor([_box_values(boxes.get(each.id)) for each in objects], dtype=torch.float64),
            votes=torch.tensor([each.votes for each in objects]),
            chamfer=torch.tensor([each.chamfer for each in objects], dtype=torch.float64),
            motion_state=torch.tensor([_MOTION_STATES.index(each.motion_state) for each in objects]),
            missed=torch.tensor([each.missed for each in objects]),
        )

    def count_objects(self) -> int:
        """Return the number of different objects."""
        return len(self["id"].unique())

    def frames_with_masked_objects(self) -> Tensor:
        """Return the indices of the frames with an object that is not static, masked by default, int64, (N,)."""
        return self["frame"][self["motion_state"] != _MOTION_STATES.index(MotionState.STATIC)].unique()

    def count_motion_states(self) -> dict[MotionState, int]:
        """Count the rows, one per frame and object, of each motion state, in the order of their first row."""
        return {_MOTION_STATES[code]: count for code, count in Counter(self["motion_state"].tolist()).items()}


def _box_values(box: UprightBox | None) -> list[float]:
    """Return centre, size and yaw of a box; NaN without a box."""
    return [torch.nan] * 7 if box is None else [*box.T_wb[:3, 3].tolist(), *box.size.tolist(), box.yaw]


class StateTable(TensorTable):
    """States of the camera at each frame, without later corrections, one row per frame.

    The columns are those of `CameraState` without the covariances of the twist.
    """

    def __init__(self) -> None:
        super().__init__(
            stamp=((), torch.float64),
            status=((), torch.int64),
            T_wc=((3, 4), torch.float64),
            covariance=((6, 6), torch.float32),
            twist=((6,), torch.float32),
        )

    def append_state(self, state: CameraState) -> None:
        """Append the state at a frame."""
        self.append(
            stamp=torch.tensor([state.stamp], dtype=torch.float64),
            status=torch.tensor([TRACKING_STATUSES.index(state.status)]),
            T_wc=state.T_wc[None, :3],
            covariance=state.covariance[None].to(torch.float32),
            twist=state.twist[None].to(torch.float32),
        )

    @property
    def statuses(self) -> list[TrackingStatus]:
        """Status of each frame when it was tracked."""
        return [TRACKING_STATUSES[code] for code in self["status"].tolist()]


class LiveTable(TensorTable):
    """Latencies of the pose and of the result of each live frame, seconds, and number of frames dropped before it."""

    def __init__(self) -> None:
        super().__init__(pose_latency=((), torch.float64), latency=((), torch.float64), dropped=((), torch.int64))

    @property
    def dropped(self) -> int:
        """Number of frames that were dropped."""
        return int(self["dropped"].sum())

    def append_result(self, result: LiveResult) -> None:
        """Append a live frame."""
        pose_latency, latency = torch.tensor([[result.pose_latency], [result.latency]], dtype=torch.float64)
        self.append(pose_latency=pose_latency, latency=latency, dropped=torch.tensor([result.dropped]))

    def statistics(self, name: str) -> dict[str, float] | None:
        """Return median, 95th percentile and maximum of a latency, seconds; None without frames.

        Args:
            name: ``pose_latency`` or ``latency``.
        """
        if not len(self):
            return None
        latency = self[name]
        median, p95 = latency.quantile(torch.tensor([0.5, 0.95], dtype=torch.float64)).tolist()
        return {"median": median, "p95": p95, "max": float(latency.max())}


@dataclass
class RunRecord:
    """Records of a run in addition to the trajectory.

    Attributes:
        times: Time spent on each frame.
        states: State of the camera at each frame.
        live: Latencies of each frame of a live run; empty for a stored sequence.
        rejected: Number of live frames that were late, duplicate or out of order.
        objects: Objects of all frames.
        snapshots: Frames for the figure of masks.
        most_dynamic_snapshot: Frame with the most votes for dynamic objects; of several, that with the most objects.
        mask_evaluation: Comparison of the masks with true masks.
        broken: Broken frames that were skipped.
        seconds: Wall time of all frames without the comparison with true masks, seconds.
        failure: Reason why the run ended before the end of the sequence, or why a file of a whole run could not be
            written; None if there is none.
        diagnosis: Cause of incomplete results of a run that reached the end of the sequence; None if they are complete.
        interrupted: True if the user interrupted the run.
        mask_error: Reason why the masks were not evaluated although there are true masks; None if there was no error.
        save_error: Reason why a checkpoint could not be written; None if there was no error.
        warnings: Contradictions between the images and the camera, notes on the source, and map files that were not
            written, one sentence each.
        repeated: Colour images that repeat the one before.
        repeated_depth: Depth images that repeat the one before.
        people_sizes: Apparent sizes of people in the keyframes before the check, metres.
        was_checked: True if camera and depth were checked.
    """

    times: FrameTimes = field(default_factory=FrameTimes)
    states: StateTable = field(default_factory=StateTable)
    live: LiveTable = field(default_factory=LiveTable)
    rejected: int = 0
    objects: ObjectTable = field(default_factory=ObjectTable)
    snapshots: list[Snapshot] = field(default_factory=list)
    most_dynamic_snapshot: Snapshot | None = None
    mask_evaluation: MaskEvaluation = field(default_factory=MaskEvaluation)
    broken: list[BrokenFrame] = field(default_factory=list)
    seconds: float = 0.0
    failure: str | None = None
    diagnosis: str | None = None
    interrupted: bool = False
    mask_error: str | None = None
    save_error: str | None = None
    warnings: list[str] = field(default_factory=list)
    repeated: RepeatedImages = field(default_factory=RepeatedImages)
    repeated_depth: RepeatedImages = field(default_factory=RepeatedImages)
    people_sizes: list[float] = field(default_factory=list)
    was_checked: bool = False

    def add_failure(self, reason: str) -> None:
        """Record a failure after the last frame, after those recorded before."""
        self.failure = reason if self.failure is None else f"{self.failure}; {reason}"
