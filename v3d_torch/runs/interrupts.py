"""Ctrl-C between two frames."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from types import FrameType

from v3d_torch.datasets.base import LiveStream, RGBDStream

_STOP_INTERVAL = 0.1
"""Interval at which a source is stopped after Ctrl-C, seconds."""


@contextmanager
def interrupts_between_frames(source: RGBDStream | None = None) -> Iterator[Event]:
    """Delay Ctrl-C until the current frame is complete; a second Ctrl-C interrupts at once.

    Args:
        source: Source of the frames. Ctrl-C also stops a `LiveStream`, because the next frame of a camera that was
            unplugged may never come. None, or a source of another kind, is not stopped.

    Returns:
        Event that is set by Ctrl-C.

    Raises:
        ValueError: If this is not the main thread.
    """
    interrupted, is_over, woken = Event(), Event(), Event()

    def delay(signum: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()
        woken.set()

    previous = signal.signal(signal.SIGINT, delay)
    try:
        if isinstance(source, LiveStream):
            # In a thread: the handler runs in the main thread, which can hold a lock that stop needs.
            Thread(target=_stop_after_waking, args=(source, woken, is_over), daemon=True).start()
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, previous)
        is_over.set()
        woken.set()


def _stop_after_waking(source: LiveStream, woken: Event, is_over: Event) -> None:
    """Wait for Ctrl-C or for the end of the context, and stop the source until the end of the context.

    One stop is not enough: it has no effect on an iteration that begins later.
    """
    woken.wait()
    while not is_over.is_set():
        source.stop()
        is_over.wait(_STOP_INTERVAL)
