"""Capture of frames in a thread: order, time of capture, errors, and memory of a long run."""

from __future__ import annotations

import logging
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import pytest
import torch

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.live.frame_capture import CapturedFrame, FrameCapture
from v3d_torch.live.latest_queue import LatestQueue
from v3d_torch.runtime.clock import MONOTONIC_CLOCK
from v3d_torch.types import RGBDFrame

FRAME = RGBDFrame(0, 0.0, torch.zeros(3, 2, 2, dtype=torch.uint8), torch.ones(1, 2, 2))


class AllItems(LatestQueue[CapturedFrame]):
    """Queue that keeps all items, for a source that does not wait."""

    def __init__(self) -> None:
        super().__init__()
        self.items: list[CapturedFrame] = []
        self.closed = threading.Event()

    def put(self, item: CapturedFrame) -> None:
        self.items.append(item)

    def close(self, error: BaseException | None = None) -> None:
        super().close(error)
        self.closed.set()


def frames_at(stamps: Iterable[float]) -> Iterator[RGBDFrame]:
    return (replace(FRAME, index=index, stamp=stamp) for index, stamp in enumerate(stamps))


def accept(frame: RGBDFrame) -> None:
    pass


def capture(source: Iterable[RGBDFrame], check: Callable[[RGBDFrame], None] = accept) -> tuple[FrameCapture, AllItems]:
    """Capture all frames of a source."""
    captured, queue = FrameCapture(source, check, MONOTONIC_CLOCK), AllItems()
    captured.frames = queue
    captured.start()
    assert queue.closed.wait(60)
    return captured, queue


def test_late_doubled_and_reordered_frames_are_rejected_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    """Frames less than a microsecond apart count as doubled, as in trajectory files."""
    with caplog.at_level(logging.WARNING):
        captured, queue = capture(frames_at([0.0, 1.0, 1.0, 0.5, 2.0, 2.0000003, 4.0, 3.0, 5.0]))
    assert [item.frame.stamp for item in queue.items] == [0.0, 1.0, 2.0, 4.0, 5.0]
    assert [item.number for item in queue.items] == [1, 2, 3, 4, 5]
    assert captured.rejected == 4
    rejected = ["frame 2 is rejected", "frame 5 is rejected", "frame 7 is rejected"]
    assert [record.getMessage()[:19] for record in caplog.records] == rejected


def test_clock_that_was_set_back_is_an_input_error() -> None:
    captured, queue = capture(frames_at([100.0, *(n / 30 for n in range(1000))]))
    assert len(queue.items) == 1 and captured.rejected == 150
    with pytest.raises(InputError, match="the clock of the source was set back; start again"):
        queue.take()


def test_capture_ends_with_the_error_of_the_source_or_the_check() -> None:
    def broken() -> Iterator[RGBDFrame]:
        yield FRAME
        raise InputError("cable")

    def check(frame: RGBDFrame) -> None:
        if frame.index == 2:
            raise InputError("size")

    for source, accepted, count, message in ((broken(), accept, 1, "cable"), (frames_at(range(5)), check, 2, "size")):
        _, queue = capture(source, accepted)
        assert len(queue.items) == count
        with pytest.raises(InputError, match=message):
            queue.take()


def test_time_of_capture_is_that_of_a_live_stream_or_the_arrival() -> None:
    class Camera:
        name, camera, groundtruth = "camera", PinholeCamera(fx=1, fy=1, cx=0, cy=0), None

        def __iter__(self) -> Iterator[RGBDFrame]:
            return frames_at(range(3))

        def captured_at(self, frame: RGBDFrame) -> float:
            return frame.stamp - 1000

        def stop(self) -> None:
            pass

    assert [item.captured_at for item in capture(Camera())[1].items] == [-1000, -999, -998]
    start = MONOTONIC_CLOCK.now()
    times = [item.captured_at for item in capture(frames_at(range(3)))[1].items]
    assert start <= times[0] <= times[1] <= times[2] <= MONOTONIC_CLOCK.now()


def test_number_of_a_frame_counts_those_that_the_source_skipped() -> None:
    class Bag:
        skipped = 0

        def __iter__(self) -> Iterator[RGBDFrame]:
            for frame, skipped in zip(frames_at(range(3)), (0, 2, 5), strict=True):
                self.dropped = skipped
                yield frame

    assert [item.number for item in capture(Bag())[1].items] == [1, 4, 8]


def test_closing_stops_source_and_thread() -> None:
    stopped, taken = threading.Event(), threading.Event()

    class Endless:
        name, camera, groundtruth = "camera", PinholeCamera(fx=1, fy=1, cx=0, cy=0), None

        def __iter__(self) -> Iterator[RGBDFrame]:
            yield FRAME
            taken.set()
            stopped.wait(60)

        def captured_at(self, frame: RGBDFrame) -> float:
            return 0.0

        def stop(self) -> None:
            stopped.set()

    before = set(threading.enumerate())
    captured = FrameCapture(Endless(), accept, MONOTONIC_CLOCK)
    captured.start()
    assert taken.wait(5)
    assert [thread.name for thread in set(threading.enumerate()) - before] == ["capture"]
    captured.close()
    assert set(threading.enumerate()) <= before


def test_source_that_does_not_end_is_reported(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("v3d_torch.live.frame_capture._JOIN_TIMEOUT", 0.05)
    taken, end = threading.Event(), threading.Event()

    def waiting() -> Iterator[RGBDFrame]:
        yield FRAME
        taken.set()
        end.wait(60)

    captured = FrameCapture(waiting(), accept, MONOTONIC_CLOCK)
    captured.start()
    assert taken.wait(5)
    captured.close()
    end.set()
    (message,) = (record.getMessage() for record in caplog.records)
    assert message == "the source of the frames does not end: a thread waits for its next frame; end the source"


def test_ten_minutes_without_a_consumer_keep_only_the_first_and_the_newest_frame() -> None:
    """18,000 frames at 30 Hz arrive, and no thread takes any; every hundredth is late."""
    references: list[weakref.ref[RGBDFrame]] = []

    def ten_minutes() -> Iterator[RGBDFrame]:
        for index in range(18_000):
            frame = replace(FRAME, index=index, stamp=(index - 5 * (index % 100 == 99)) / 30)
            references.append(weakref.ref(frame))
            yield frame

    captured = FrameCapture(ten_minutes(), accept, MONOTONIC_CLOCK)
    logging.disable(logging.WARNING)
    try:
        captured.start()
        captured._thread.join(60)
    finally:
        logging.disable(logging.NOTSET)
    assert captured.rejected == 180
    assert [index for index, reference in enumerate(references) if reference() is not None] == [0, 17_998]
    first, item = captured.frames.take(), captured.frames.take()
    assert first is not None and (first.frame.index, first.number) == (0, 1)
    assert item is not None and (item.frame.index, item.number) == (17_998, 18_000 - 180)
