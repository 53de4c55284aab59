"""Ctrl-C between two frames."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event
from types import FrameType


@contextmanager
def interrupts_between_frames() -> Iterator[Event]:
    """Delay Ctrl-C until the current frame is complete; a second Ctrl-C interrupts at once."""
    interrupted = Event()

    def delay(signum: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()

    previous = signal.signal(signal.SIGINT, delay)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, previous)
