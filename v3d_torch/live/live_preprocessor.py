"""Preprocessing of the newest frame while an earlier frame is tracked."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Thread

from v3d_torch.frame_result import PreprocessedFrame, Segmentation
from v3d_torch.live.frame_capture import CapturedFrame
from v3d_torch.live.latest_queue import LatestQueue
from v3d_torch.runtime.inference_mode import in_current_mode
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame


@dataclass(frozen=True)
class LiveFrame:
    """A captured frame whose features are complete; its segmentation may still run.

    Attributes:
        captured: Frame with the time of its capture.
        preprocessed: Frame for `V3DSLAM.track`.
        is_segmented: True if the network segments the frame.
    """

    captured: CapturedFrame
    preprocessed: PreprocessedFrame
    is_segmented: bool


class LivePreprocessor:
    """Two threads that preprocess one frame at a time: one extracts features, the other segments.

    As soon as the features of a frame are complete, the frame is ready for tracking, and replaces an earlier frame
    whose tracking has not begun. Tracking waits for the segmentation when it needs the instances.

    A frame is segmented if it is at least the ``segmentation.interval``-th after the last tracked frame that was
    segmented. While frames are dropped, at most every second frame is segmented, so that tracking can catch up.

    Args:
        captured: Queue of captured frames.
        slam: System that preprocesses the frames.

    Attributes:
        frames: Queue with the newest frame that is ready for tracking.
    """

    def __init__(self, captured: LatestQueue[CapturedFrame], slam: V3DSLAM) -> None:
        self.frames = LatestQueue[LiveFrame]()
        self._captured = captured
        self._slam = slam
        self._prediction = slam.predictions[-1]
        self._last_tracked = 0  # number of the last frame whose tracking has begun
        self._last_segmented = -slam.config.segmentation.interval  # number of the last such frame that was segmented
        self._segmenter = ThreadPoolExecutor(1, "segmentation")
        self._thread = Thread(target=in_current_mode(self._run), name="features", daemon=True)

    def start(self) -> None:
        """Start the threads."""
        self._thread.start()

    def begin_tracking(self, live: LiveFrame) -> None:
        """Record that the tracking of a frame begins."""
        if live.is_segmented:
            self._last_segmented = live.captured.number
        self._last_tracked = live.captured.number

    def end_tracking(self) -> None:
        """Store the newest pose prediction, after the tracking of a frame."""
        self._prediction = self._slam.advance_predictions()

    def close(self) -> None:
        """Stop the threads after their current frame. Close the queue of captured frames first."""
        self.frames.close()
        if self._thread.is_alive():
            self._thread.join()
        self._segmenter.shutdown()

    def _run(self) -> None:
        try:
            while (captured := self._captured.take()) is not None:
                self._preprocess(captured)
        except BaseException as error:
            self.frames.close(error)
        else:
            self.frames.close()

    def _preprocess(self, captured: CapturedFrame) -> None:
        is_segmented = self._is_segmentation_due(captured.number)
        segmentation = self._segmenter.submit(in_current_mode(self._segment), captured.frame, is_segmented)
        extraction = self._slam.extract_features(captured.frame)
        preprocessed = PreprocessedFrame(captured.frame, extraction, segmentation.result)
        self.frames.put(LiveFrame(captured, preprocessed, is_segmented))
        segmentation.result()  # also raises the error of a frame that is never tracked

    def _is_segmentation_due(self, number: int) -> bool:
        since_segmented, since_tracked = number - self._last_segmented, number - self._last_tracked
        is_catching_up = since_tracked > 1 and self._last_segmented == self._last_tracked
        return since_segmented >= self._slam.config.segmentation.interval and not is_catching_up

    def _segment(self, frame: RGBDFrame, is_due: bool) -> Segmentation:
        return self._slam.segment_instances(frame, self._prediction, is_due)
