"""SLAM on live frames: equality with an offline run, dropped frames, latency, and ends of a run."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from queue import Queue
from typing import Any

import pytest
import torch
from helpers.short_wall import CAMERA, FRAMES, Wall, square
from helpers.waiting import wait_until
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.realtime_playback import RealtimePlayback
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.live import LiveResult, LiveSLAM
from v3d_torch.live.frame_capture import CapturedFrame, FrameCapture
from v3d_torch.live.latest_queue import LatestQueue
from v3d_torch.live.live_preprocessor import LivePreprocessor
from v3d_torch.objects.appearance import colour_histograms
from v3d_torch.runtime.clock import MONOTONIC_CLOCK
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame, TrackingStatus


def feed(wall: Wall | None = None) -> tuple[Iterator[RGBDFrame], Any]:
    """Return a source of the frames along the wall, each of which comes when the returned function is called."""
    queue: Queue[RGBDFrame | None] = Queue()
    frames = iter([(wall or Wall())[index] for index in range(FRAMES)])

    def send(*_: object) -> None:
        queue.put(next(frames, None))

    send()
    return iter(queue.get, None), send


def test_results_of_a_slow_camera_equal_those_of_an_offline_run() -> None:
    source, send = feed()
    live, offline = LiveSLAM(source, V3DSLAM(CAMERA, square)), V3DSLAM(CAMERA, square)
    results = []
    for result in live:
        results.append(result)
        send()
    for index, result in enumerate(results):
        expected = offline(Wall()[index])
        assert torch.equal(result.T_wc, expected.T_wc) and torch.equal(result.covariance, expected.covariance)
        assert torch.equal(result.twist, expected.twist) and torch.equal(result.static_mask, expected.static_mask)
        assert (result.stamp, result.status, result.dropped) == (expected.stamp, expected.status, 0)
    assert len(results) == FRAMES and live.dropped == live.rejected == 0


def test_each_result_has_state_and_times() -> None:
    source, send = feed()
    results: list[LiveResult] = []
    start = time.monotonic()
    live = LiveSLAM(source, V3DSLAM(CAMERA, square))
    live(lambda result: (results.append(result), send()))
    assert len(results) == FRAMES
    for index, result in enumerate(results):
        assert result.frame.index == index and result.stamp == pytest.approx(index / 10)
        assert result.status is TrackingStatus.TRACKED
        assert start < result.captured_at < result.finished_at < time.monotonic()
        assert result.latency == result.finished_at - result.captured_at
        assert result.pose_latency == result.measured_at - result.captured_at
        assert torch.linalg.eigvalsh(result.covariance).min() >= 0
        assert result.twist.shape == (6,)
    assert live.pose_at(results[3].stamp).T_wc.allclose(results[3].T_wc, atol=1e-3)


def test_pose_is_known_before_the_network_has_found_the_objects() -> None:
    source, send = feed()
    step = float(Wall().groundtruth.T_wc[1, 0, 3])
    waited_for: list[int] = []

    def segment(frame: RGBDFrame) -> Instances:
        if frame.index == 1:
            pose = pytest.approx(step, rel=0.1)
            wait_until(
                lambda: float(live.pose_at(frame.stamp).T_wc[0, 3]) == pose, timeout=10, what="the pose is known"
            )
            waited_for.append(frame.index)
        return square(frame)

    live = LiveSLAM(source, V3DSLAM(CAMERA, segment))
    results = []
    for result in live:
        results.append(result)
        send()
    assert waited_for == [1]
    first, *others = results
    assert first.pose_latency == first.latency  # without a frame before, no motion is measured
    for result in others:
        assert 0 < result.pose_latency < result.latency


def test_frames_that_come_while_one_is_processed_are_left_out_but_the_newest() -> None:
    """All later frames come while the first one is tracked: two are ready or in preprocessing, and the last one."""
    source, send = feed()
    all_captured = threading.Event()

    def frames() -> Iterator[RGBDFrame]:
        yield from source
        all_captured.set()  # the queue of the capture holds the last frame, or it was taken already

    def on_result(result: LiveResult) -> None:
        if result.frame.index == 0:
            for _ in range(FRAMES):
                send()
            wait_until(all_captured.is_set, timeout=100, what="all frames were captured")

    results: list[LiveResult] = []
    live = LiveSLAM(frames(), V3DSLAM(CAMERA, square))
    live(lambda result: (results.append(result), on_result(result)))
    indices = [result.frame.index for result in results]
    assert indices[0] == 0 and indices[-1] == FRAMES - 1 and len(indices) <= 4
    assert [result.dropped for result in results[1:]] == [b - a - 1 for a, b in itertools.pairwise(indices)]
    assert live.dropped == FRAMES - len(indices) == sum(result.dropped for result in results)


def test_stages_of_the_package_are_called_before_the_camera_starts() -> None:
    """The first call of colour histograms builds the tables of the colour space: it needs an object to do so."""
    events: list[object] = []

    def describe(image: Tensor, masks: Tensor) -> Tensor:
        events.append(len(masks))
        return colour_histograms(image, masks)

    def source() -> Iterator[RGBDFrame]:
        events.append("camera starts")
        yield Wall()[0]

    slam = V3DSLAM(CAMERA, square)
    vars(slam)["describe_appearance"] = describe  # as if it were the package's own
    assert len(list(LiveSLAM(source(), slam))) == 1
    assert events[:2] == [1, "camera starts"]


def test_first_frame_is_tracked_although_later_ones_wait_at_the_start() -> None:
    """Only the first frame has a measured gravity."""
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    frames = [replace(Wall()[index], gravity=down if index == 0 else None) for index in range(FRAMES)]
    live = LiveSLAM(frames, V3DSLAM(CAMERA, square))
    first = next(iter(live))
    assert first.frame.index == 0 and first.dropped == 0
    assert live.slam.gravity is not None and live.slam.gravity.allclose(down)


def test_every_second_frame_is_segmented_with_interval_2() -> None:
    source, send = feed()
    segmented: list[int] = []

    def segment(frame: RGBDFrame) -> Instances:
        segmented.append(frame.index)
        return square(frame)

    config = Config.model_validate({"segmentation": {"interval": 2}})
    LiveSLAM(source, V3DSLAM(CAMERA, segment, config))(send)
    assert segmented == list(range(0, FRAMES, 2))


class PoseAware:
    """Segmenter of the square that records the predicted position of the camera along the wall."""

    def __init__(self) -> None:
        self.positions: list[float] = []

    def __call__(self, frame: RGBDFrame) -> Instances:
        return square(frame)

    def segment_with_pose(self, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
        self.positions.append(0.0 if T_cw is None else -float(T_cw[0, 3]))
        return square(frame)


def test_segmenter_of_a_slow_camera_gets_the_pose_that_the_frame_before_predicts() -> None:
    """From this pose it computes how the image is rotated."""
    source, send = feed()
    segment, truth = PoseAware(), Wall().groundtruth
    assert truth is not None
    LiveSLAM(source, V3DSLAM(CAMERA, segment))(send)
    assert segment.positions[3:] == pytest.approx(truth.T_wc[3:, 0, 3].tolist(), abs=0.01)


def test_at_most_every_second_tracked_frame_is_segmented_while_frames_are_dropped() -> None:
    """Frames 2, 4 and 7 are dropped. A frame after a gap is not segmented if the tracked frame before it was."""
    captured = LatestQueue[CapturedFrame]()
    preprocessor = LivePreprocessor(captured, V3DSLAM(CAMERA, square))
    preprocessor.start()
    is_segmented = {}
    for number in (1, 3, 5, 6, 8):
        captured.put(CapturedFrame(Wall()[number], number, captured_at=0.0))
        live = preprocessor.frames.take()
        assert live is not None
        preprocessor.begin_tracking(live)
        is_segmented[live.captured.number] = live.is_segmented
    captured.close()
    preprocessor.close()
    assert is_segmented == {1: True, 3: False, 5: True, 6: True, 8: False}


def test_map_is_final_after_the_last_frame() -> None:
    """The result of the back end for the last keyframe was applied."""
    slam = V3DSLAM(CAMERA, square)
    assert len(list(LiveSLAM([Wall()[0]], slam))) == len(slam.map.keyframes) == 1
    assert slam.back_end.keyframe is None


def test_error_of_a_frame_ends_the_run_after_the_frames_before() -> None:
    def source() -> Iterator[RGBDFrame]:
        yield Wall()[0]
        raise InputError("cable")

    results = iter(LiveSLAM(source(), V3DSLAM(CAMERA, square)))
    assert next(results).frame.index == 0
    with pytest.raises(InputError, match="cable"):
        next(results)


def test_error_of_the_segmenter_ends_the_run() -> None:
    def segment(frame: RGBDFrame) -> Instances:
        raise ValueError("network")

    with pytest.raises(ValueError, match="network"):
        next(iter(LiveSLAM(feed()[0], V3DSLAM(CAMERA, segment))))


def test_error_of_the_segmenter_for_a_frame_that_is_not_tracked_ends_the_run() -> None:
    def segment(frame: RGBDFrame) -> Instances:
        raise ValueError("network")

    captured = LatestQueue[CapturedFrame]()
    preprocessor = LivePreprocessor(captured, V3DSLAM(CAMERA, segment))
    preprocessor.start()
    captured.put(CapturedFrame(Wall()[0], 1, 0.0))
    assert preprocessor.frames.take() is not None  # its instances are never asked for
    with pytest.raises(ValueError, match="network"):
        preprocessor.frames.take()
    captured.close()
    preprocessor.close()


def test_threads_that_were_not_started_can_be_closed() -> None:
    captured = LatestQueue[CapturedFrame]()
    LivePreprocessor(captured, V3DSLAM(CAMERA, square)).close()
    FrameCapture([], lambda frame: None, MONOTONIC_CLOCK).close()


def test_leaving_the_loop_stops_all_threads() -> None:
    source, send = feed()
    before = set(threading.enumerate())
    results = iter(LiveSLAM(source, V3DSLAM(CAMERA, square)))
    next(results)
    threading.Timer(0.1, send).start()  # this source blocks until its next frame
    results.close()
    assert {thread.name for thread in set(threading.enumerate()) - before} <= {"back-end_0"}


def test_rejected_frames_are_counted_over_several_loops() -> None:
    parts = [[Wall()[index] for index in indices] for indices in ((0, 0, 1), (2, 3))]

    class Resumed:
        def __iter__(self) -> Iterator[RGBDFrame]:
            return iter(parts.pop(0))

    live = LiveSLAM(Resumed(), V3DSLAM(CAMERA, square))
    assert list(live) and live.rejected == 1
    assert list(live) and live.rejected == 1


def test_stop_ends_the_loop_from_another_thread() -> None:
    source, send = feed()
    live, indices = LiveSLAM(source, V3DSLAM(CAMERA, square)), []

    def stop() -> None:
        live.stop()
        send()  # this source blocks until its next frame

    live.stop()  # nothing runs yet
    for result in live:
        indices.append(result.frame.index)
        if result.frame.index < 2:
            send()
        else:
            threading.Timer(0.1, stop).start()
    assert indices == [0, 1, 2]


def test_stop_ends_the_playback_of_a_sequence() -> None:
    live = LiveSLAM(RealtimePlayback(Wall()), V3DSLAM(CAMERA, square))
    assert 1 <= len([live.stop() for _ in live]) < FRAMES  # a frame that waits is tracked


def test_stored_sequence_is_rejected() -> None:
    """Most of its frames were dropped, because they do not come at their own rate."""
    sequence = load_sequence("demo")
    with pytest.raises(InputError, match=r"^demo: is stored, and most of its frames would be dropped; wrap it in Real"):
        LiveSLAM(sequence, V3DSLAM(sequence.camera, NoSegmentation()))


def test_stored_stream_without_an_index_is_rejected() -> None:
    """As a recording of librealsense, which is played as fast as it is read."""

    class Recording:
        name, camera, groundtruth = "recording", CAMERA, None

        def __iter__(self) -> Iterator[RGBDFrame]:
            return iter([])

    with pytest.raises(InputError, match=r"^recording: is stored, and most of its frames would be dropped"):
        LiveSLAM(Recording(), V3DSLAM(CAMERA, square))


def test_second_loop_is_rejected_while_the_source_waits_for_a_frame_of_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A generator cannot be asked for a frame in two threads."""
    monkeypatch.setattr("v3d_torch.live.frame_capture._JOIN_TIMEOUT", 0.05)
    queue: Queue[RGBDFrame | None] = Queue()

    def frames() -> Iterator[RGBDFrame]:
        while (frame := queue.get()) is not None:
            yield frame

    live = LiveSLAM(frames(), V3DSLAM(CAMERA, square))
    queue.put(Wall()[0])
    for _ in live:
        break
    with pytest.raises(InputError, match="the source still waits for a frame of the loop before; end the source first"):
        next(iter(live))
    queue.put(None)


@pytest.mark.parametrize("is_same", [True, False])
def test_second_loop_with_earlier_frames_is_an_input_error(is_same: bool) -> None:
    live = LiveSLAM([Wall()[1]], V3DSLAM(CAMERA, square))
    assert len(list(live)) == 1
    again = live if is_same else LiveSLAM([Wall()[1]], live.slam)
    message = r"^frame 1: its stamp is 0\.100000 s, but this system has tracked frames up to 0\.100000 s; make a new"
    with pytest.raises(InputError, match=message):
        next(iter(again))


def test_source_that_is_not_iterable_is_rejected() -> None:
    source: Any = Wall()[0]
    with pytest.raises(InputError, match="LiveSLAM needs an iterable of frames, got a RGBDFrame"):
        LiveSLAM(source, V3DSLAM(CAMERA, square))


def test_second_loop_beside_the_first_is_rejected() -> None:
    source, _ = feed()
    live = LiveSLAM(source, V3DSLAM(CAMERA, square))
    first = iter(live)
    next(first)
    with pytest.raises(InputError, match="another loop over this LiveSLAM has not ended; leave it first"):
        next(iter(live))
    first.close()
    assert live.slam.poses.stamp == Wall()[0].stamp


def test_configuration_without_threads_is_rejected() -> None:
    with pytest.raises(ConfigError, match="prefetch=false: a live camera needs threads; remove --serial"):
        LiveSLAM(iter(()), V3DSLAM(CAMERA, square, Config(prefetch=False)))


def test_hooks_and_stages_of_users_see_frames_of_the_camera_only() -> None:
    """Libraries are warmed up with an empty image, which is none of the camera's."""
    means: list[tuple[str, float]] = []

    class Detector:
        def __init__(self, detect: Any) -> None:
            self._detect = detect

        def __call__(self, image: Tensor, depth: Tensor) -> Any:
            means.append(("stage", float(image.float().mean())))
            return self._detect(image, depth)

    def record(name: str, arguments: tuple[Any, ...], result: object) -> None:
        means.append((name, float(arguments[0].float().mean())))

    slam = V3DSLAM(CAMERA, square)
    slam.detect_features = Detector(slam.detect_features)
    for name in ("detect_features", "describe_appearance"):
        slam.register_stage_hook(name, record)
    source, send = feed()
    for _ in LiveSLAM(source, slam):
        send()
    assert [name for name, _ in means].count("stage") == [name for name, _ in means].count("detect_features") == FRAMES
    assert all(mean > 0 for _, mean in means)
