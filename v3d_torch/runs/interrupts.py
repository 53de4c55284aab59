"""Ctrl-C between two frames."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from types import FrameType

from v3d_torch.datasets.base import LiveStream, RGBDStream


@contextmanager
def interrupts_between_frames(source: RGBDStream | None = None) -> Iterator[Event]:
    """Delay Ctrl-C until the current frame is complete; a second Ctrl-C interrupts at once.

    Args:
        source: Source of the frames. Ctrl-C also stops a `LiveStream`, because the next frame of a camera that was
            unplugged may never come. None, or a source of another kind, is not stopped.

    Returns:
        Event that is set by Ctrl-C.
    """
    interrupted, is_over = Event(), Event()

    def delay(signum: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()
        is_over.set()

    if isinstance(source, LiveStream):
        # In a thread: the handler runs in the main thread, which can hold a lock that stop needs.
        Thread(target=_stop_if_interrupted, args=(source, interrupted, is_over), daemon=True).start()
    previous = signal.signal(signal.SIGINT, delay)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, previous)
        is_over.set()


def _stop_if_interrupted(source: LiveStream, interrupted: Event, is_over: Event) -> None:
    """Wait for Ctrl-C or for the end of the context, and stop the source after Ctrl-C."""
    is_over.wait()
    if interrupted.is_set():
        source.stop()
