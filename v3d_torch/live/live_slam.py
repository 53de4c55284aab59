"""SLAM on a live camera: capture, preprocessing and tracking in parallel, each on the newest frame."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass

import torch

from v3d_torch.datasets.base import LiveStream, RGBDStream
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.frame_result import FrameResult
from v3d_torch.io.timestamps import round_timestamp
from v3d_torch.live.frame_capture import FrameCapture
from v3d_torch.live.live_preprocessor import LivePreprocessor
from v3d_torch.objects.assignment import match_instances
from v3d_torch.odometry.odometry import CameraMotion
from v3d_torch.runtime.clock import MONOTONIC_CLOCK, Clock
from v3d_torch.runtime.process import trim_memory_at_intervals
from v3d_torch.runtime.stage_hooks import without_hooks
from v3d_torch.slam import V3DSLAM
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.types import RGBDFrame


@dataclass(frozen=True, kw_only=True)
class LiveResult(FrameResult):
    """Result of a live frame.

    Attributes:
        frame: Frame to which the result belongs.
        captured_at: Time of capture in the clock of the computer (`time.monotonic`), seconds; ``stamp`` is the time in
            the clock of the camera.
        measured_at: Time in the clock of the computer, seconds, at which the motion since the previous frame was
            measured, from which `pose_at` computes the pose of this frame before its objects are known; the time of
            this result if the motion was not measured.
        finished_at: Time of this result in the clock of the computer, seconds.
        dropped: Number of frames that were dropped since the previous result.
    """

    frame: RGBDFrame
    captured_at: float
    measured_at: float
    finished_at: float
    dropped: int

    @property
    def latency(self) -> float:
        """Time from the capture of the frame to its result, seconds."""
        return self.finished_at - self.captured_at

    @property
    def pose_latency(self) -> float:
        """Time from the capture of the frame to its first pose, seconds."""
        return self.measured_at - self.captured_at


class LiveSLAM:
    """Runs `V3DSLAM` on a live camera: capture, preprocessing and tracking run in parallel.

    Each stage takes the newest frame that is ready, and no other frame waits, except the first. If tracking is slower
    than the camera, frames are dropped and counted. Iterate over the results, or call the object with a callback; both
    end with the source, or by `stop`. Several loops can follow each other if their frames are later and later.

    Args:
        source: Frames at their own rate: a camera (``open_source("realsense:")``), a `RealtimePlayback`, or any
            iterable that waits for its next frame, such as ``iter(queue.get, None)``.
        slam: System, made for the camera of the source.

    Attributes:
        dropped: Number of frames that were dropped so far.

    Raises:
        InputError: If the source is a stored sequence, whose frames do not come at their own rate, or not iterable.
        ConfigError: If the configuration does not allow threads (``prefetch=false``).
    """

    def __init__(self, source: Iterable[RGBDFrame], slam: V3DSLAM) -> None:
        if not slam.config.prefetch:
            raise ConfigError("prefetch=false: a live camera needs threads; remove --serial or set prefetch=true")
        if isinstance(source, RGBDStream) and not isinstance(source, LiveStream):
            raise InputError(
                f"{source.name}: is stored, and most of its frames would be dropped; wrap it in RealtimePlayback, or"
                " call slam(frame) for each frame"
            )
        if not isinstance(source, Iterable):
            raise InputError(f"LiveSLAM needs an iterable of frames, got a {type(source).__name__}")
        self.slam = slam
        self.dropped = 0
        self._source = source
        self._clock: Clock = MONOTONIC_CLOCK
        self._capture: FrameCapture | None = None
        self._is_running = False
        self._rejected_before = 0  # by the captures before this one
        self._measured_at: float | None = None  # time at which the motion to the newest frame was measured

    @property
    def rejected(self) -> int:
        """Number of frames so far that were not later than all frames before: late, duplicate or out of order."""
        return self._rejected_before + (0 if self._capture is None else self._capture.rejected)

    def __iter__(self) -> Generator[LiveResult, None, None]:
        """Start the source and yield the result of each tracked frame.

        The frames that are being captured and preprocessed when the loop is left are discarded, and not counted.

        Raises:
            InputError: If another loop over this object has not ended, or the source still waits for a frame of it. If
                the source ends with an error, a frame is not valid, or the first one is not later than the frames that
                the system has tracked.
            ConfigError: If the segmenter did not return valid `Instances`.
        """
        if self._is_running:
            raise InputError("another loop over this LiveSLAM has not ended; leave it first")
        if self._capture is not None and self._capture.is_waiting:
            raise InputError("the source still waits for a frame of the loop before; end the source first")
        self._is_running = True
        try:
            yield from self._run()
        finally:
            self._is_running = False

    def __call__(self, on_result: Callable[[LiveResult], object]) -> None:
        """Run until the source ends, and call back with each result.

        Args:
            on_result: Called in this thread. If it takes long, frames are dropped.

        Raises:
            InputError: As for iteration.
            ConfigError: As for iteration.
        """
        for result in self:
            on_result(result)

    def stop(self) -> None:
        """End the iteration; can be called from any thread. It has no effect on an iteration that has not begun.

        Frames that already wait are still tracked. A `LiveStream` is stopped. Any other source has to end by itself;
        the iteration ends without it, after a wait of two seconds, and its thread waits for its next frame.
        """
        if self._capture is not None:
            self._capture.stop()

    def pose_at(self, stamp: float) -> CameraState:
        """Return the state of the camera at a time, see `V3DSLAM.pose_at`; can be called from any thread."""
        return self.slam.pose_at(stamp)

    def _run(self) -> Generator[LiveResult, None, None]:
        """Start the source and yield the result of each tracked frame, see `__iter__`."""
        self._rejected_before = self.rejected
        self._capture = capture = FrameCapture(self._source, self.slam.check, self._clock)
        _warm_up(self.slam)
        preprocessor = LivePreprocessor(capture.frames, self.slam)
        hook = self.slam.register_stage_hook("odometry", self._record_motion)
        with closing(preprocessor), closing(capture), hook:
            capture.start()
            preprocessor.start()
            number = 0
            while (live := preprocessor.frames.take()) is not None:
                if number == 0:
                    self._check_first(live.captured.frame)
                preprocessor.begin_tracking(live)
                result = self.slam.track(live.preprocessed)
                preprocessor.end_tracking()
                finished_at, captured = self._clock.now(), live.captured
                measured_at = finished_at if self._measured_at is None else self._measured_at
                dropped, number = captured.number - number - 1, captured.number
                self.dropped += dropped
                yield LiveResult(
                    **vars(result),
                    frame=captured.frame,
                    captured_at=captured.captured_at,
                    measured_at=measured_at,
                    finished_at=finished_at,
                    dropped=dropped,
                )
                trim_memory_at_intervals(len(self.slam.poses))
            self.slam.flush()

    def _check_first(self, frame: RGBDFrame) -> None:
        """Raise InputError if the first frame of a loop is not later than the frames that the system has tracked."""
        tracked = self.slam.poses.stamp
        if round_timestamp(frame.stamp) <= round_timestamp(tracked):
            raise InputError(
                f"frame {frame.index}: its stamp is {frame.stamp:.6f} s, but this system has tracked frames up to"
                f" {tracked:.6f} s; make a new V3DSLAM"
            )

    def _record_motion(self, name: str, arguments: tuple[object, ...], motion: CameraMotion) -> None:
        self._measured_at = self._clock.now() if motion.is_measured else None


@torch.no_grad()
def _warm_up(slam: V3DSLAM) -> None:
    """Call the package's own stages without state once, on an empty image with one object, and without their hooks.

    Libraries build tables and load modules at their first call, for a third of a second, in which ten frames would be
    dropped. Stages and hooks of users see frames of the camera only.
    """
    size = slam.camera.height, slam.camera.width
    image, depth = torch.zeros(3, *size, dtype=torch.uint8), torch.ones(1, *size)
    arguments = {
        "smooth_depth": (depth[None],),
        "detect_features": (image, depth),
        "describe_appearance": (image, torch.ones(1, *size, dtype=torch.bool)),
    }
    for name, given in arguments.items():
        if name not in slam.replaced_stages:
            without_hooks(getattr(slam, name))(*given)
    match_instances(torch.ones(1, 1, 1))
