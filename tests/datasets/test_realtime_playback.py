"""Playback of a stored sequence at its own rate, with a simulated clock."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import pytest
from helpers.short_wall import CAMERA, FRAMES, StoredWall

from v3d_torch.datasets.base import LiveStream
from v3d_torch.datasets.realtime_playback import RealtimePlayback, stored_source
from v3d_torch.errors import InputError
from v3d_torch.types import RGBDFrame


class SimulatedClock:
    """Clock that shows the sum of all waits."""

    def __init__(self) -> None:
        self.time = 50.0

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += max(seconds, 0.0)


def test_frames_come_when_they_are_due() -> None:
    clock = SimulatedClock()
    playback = RealtimePlayback(StoredWall(), clock)
    for index, frame in enumerate(playback):
        assert frame.index == index
        assert clock.time == pytest.approx(50 + index / 10)
        assert playback.captured_at(frame) == pytest.approx(clock.time)
        clock.time += 0.03  # of the consumer, which does not delay the next frame
    assert index == FRAMES - 1


def test_frame_of_a_stream_that_is_read_too_late_counts_as_captured_when_it_was_due() -> None:
    class Stream:
        name, camera, groundtruth = "stream", CAMERA, None

        def __iter__(self) -> Iterator[RGBDFrame]:
            return iter(StoredWall())

    clock = SimulatedClock()
    playback = RealtimePlayback(Stream(), clock)
    frames = iter(playback)
    next(frames)
    clock.time += 5
    frame = next(frames)
    assert clock.time == 55 and playback.captured_at(frame) == pytest.approx(50.1) and playback.dropped == 0


def test_frames_of_a_sequence_that_are_already_due_are_skipped() -> None:
    clock = SimulatedClock()
    playback = RealtimePlayback(StoredWall(), clock)
    frames = iter(playback)
    assert next(frames).index == 0
    clock.time += 0.35  # frames 1 to 3 are due
    assert next(frames).index == 4 and playback.dropped == 3
    assert clock.time == pytest.approx(50.4)
    clock.time += 100  # the last frame comes in any case
    assert [frame.index for frame in frames] == [FRAMES - 1] and playback.dropped == FRAMES - 3
    assert len(list(playback)) == FRAMES and playback.dropped == 0


def test_stop_ends_the_iteration_and_the_next_one_starts_again() -> None:
    playback = RealtimePlayback(StoredWall(), SimulatedClock())
    frames = iter(playback)
    assert [frame.index for frame in islice(frames, 3)] == [0, 1, 2]
    playback.stop()
    assert list(frames) == []
    assert len(list(playback)) == FRAMES


def test_stop_ends_the_wait_in_a_gap_of_the_recording() -> None:
    class StoppingClock(SimulatedClock):
        def sleep(self, seconds: float) -> None:
            super().sleep(seconds)
            playback.stop()

    class Stream:
        name, camera, groundtruth = "stream", CAMERA, None

        def __iter__(self) -> Iterator[RGBDFrame]:
            yield StoredWall()[0]
            yield replace(StoredWall()[1], stamp=1000.0)

    clock = StoppingClock()
    playback = RealtimePlayback(Stream(), clock)
    assert [frame.index for frame in playback] == [0]
    assert clock.time < 51


def test_playback_has_name_camera_and_ground_truth_of_its_source_and_is_live() -> None:
    wall = StoredWall()
    playback = RealtimePlayback(wall)
    assert isinstance(playback, LiveStream)
    assert (playback.name, playback.camera, playback.groundtruth) == (wall.name, wall.camera, wall.groundtruth)
    with pytest.raises(InputError, match="wall: is a live camera, which always has its own rate; remove --realtime"):
        RealtimePlayback(playback)


def test_stored_source_is_what_a_playback_plays_and_any_other_source_itself() -> None:
    wall = StoredWall()
    assert stored_source(RealtimePlayback(wall)) is wall and stored_source(wall) is wall
