from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import pytest
from helpers.long_wall import CAMERA

from v3d_torch.runs.interrupts import interrupts_between_frames
from v3d_torch.runtime.hangup import HANGUP, handled_hangup
from v3d_torch.types import RGBDFrame

pytestmark = pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself")


class WaitingCamera:
    """`LiveStream` whose first frame never comes."""

    name, camera, groundtruth = "waiting", CAMERA, None

    def __init__(self) -> None:
        self.stopped = threading.Event()

    def __iter__(self) -> Iterator[RGBDFrame]:
        self.stopped.clear()
        self.stopped.wait()
        yield from ()

    def captured_at(self, frame: RGBDFrame) -> float:
        return frame.stamp

    def stop(self) -> None:
        self.stopped.set()


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, *handled_hangup()])
def test_first_signal_ends_a_camera_that_sends_nothing(number: signal.Signals) -> None:
    camera = WaitingCamera()
    with interrupts_between_frames(camera) as interrupted:
        threading.Timer(0.1, os.kill, (os.getpid(), number)).start()
        assert list(camera) == []
        assert interrupted.is_set() and camera.stopped.is_set()


def test_ctrl_c_before_the_first_frame_is_read_ends_the_camera() -> None:
    camera = WaitingCamera()
    with interrupts_between_frames(camera):
        press_ctrl_c()
        camera.stopped.wait()
        assert list(camera) == []


def test_no_thread_is_left_outside_of_the_main_thread() -> None:
    camera, errors, before = WaitingCamera(), list[ValueError](), set(threading.enumerate())

    def enter() -> None:
        try:
            with interrupts_between_frames(camera):
                pass
        except ValueError as error:
            errors.append(error)

    outside = threading.Thread(target=enter)
    outside.start()
    outside.join()
    assert len(errors) == 1 and set(threading.enumerate()) <= before


def test_second_ctrl_c_interrupts_at_once() -> None:
    with interrupts_between_frames() as interrupted:
        press_ctrl_c()
        assert interrupted.is_set()
        with pytest.raises(KeyboardInterrupt):
            press_ctrl_c()


@pytest.mark.skipif(not handled_hangup(), reason="SIGHUP is ignored, as by nohup")
def test_lost_terminal_that_is_reported_twice_does_not_interrupt_at_once() -> None:
    with interrupts_between_frames() as interrupted:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGHUP)
        assert interrupted.is_set()
        with pytest.raises(KeyboardInterrupt):
            press_ctrl_c()


def test_lost_terminal_is_ignored_if_the_caller_ignores_it() -> None:
    """``nohup`` does."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts_between_frames() as interrupted:
            os.kill(os.getpid(), signal.SIGHUP)
        assert not interrupted.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_camera_is_not_stopped_without_ctrl_c() -> None:
    camera, signals = WaitingCamera(), (signal.SIGINT, signal.SIGTERM, *HANGUP)
    before = list(map(signal.getsignal, signals))
    threads = set(threading.enumerate())
    with interrupts_between_frames(camera) as interrupted:
        watching = set(threading.enumerate()) - threads
    for thread in watching:
        thread.join(5)
    assert not interrupted.is_set() and not camera.stopped.is_set()
    assert list(map(signal.getsignal, signals)) == before and set(threading.enumerate()) <= threads
