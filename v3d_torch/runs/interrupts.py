"""Ctrl-C, the signal to end a process, or the loss of the terminal, between two frames."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from types import FrameType

from v3d_torch.datasets.base import LiveStream, RGBDStream
from v3d_torch.runtime.hangup import HANGUP, handled_hangup, leave_terminal

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a run, beside that of a lost terminal: that of Ctrl-C, and that with which a system or a container
ends its processes."""

_STOP_INTERVAL = 0.1
"""Interval at which a source is stopped after a signal, seconds."""


@contextmanager
def interrupts_between_frames(source: RGBDStream | None = None) -> Iterator[Event]:
    """Delay Ctrl-C, SIGTERM and SIGHUP until the current frame is complete; a second one interrupts at once.

    SIGHUP, of a terminal that is lost, never interrupts at once: the system and the shell both send it.

    Args:
        source: Source of the frames. The signal also stops a `LiveStream`, because the next frame of a camera that was
            unplugged may never come. None, or a source of another kind, is not stopped.

    Yields:
        Event that is set by the signal.

    Raises:
        ValueError: If this is not the main thread.
    """
    interrupted, is_over, woken = Event(), Event(), Event()

    def delay(signum: int, frame: FrameType | None) -> None:
        if signum in HANGUP:
            leave_terminal()
        elif interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()
        woken.set()

    previous = {each: signal.signal(each, delay) for each in (*_SIGNALS, *handled_hangup())}
    try:
        if isinstance(source, LiveStream):
            # In a thread: the handler runs in the main thread, which can hold a lock that stop needs.
            Thread(target=_stop_after_waking, args=(source, woken, is_over), daemon=True).start()
        yield interrupted
    finally:
        for each, handler in previous.items():
            signal.signal(each, handler)
        is_over.set()
        woken.set()


def _stop_after_waking(source: LiveStream, woken: Event, is_over: Event) -> None:
    """Wait for a signal or for the end of the context, and stop the source until the end of the context.

    One stop is not enough: it has no effect on an iteration that begins later.
    """
    woken.wait()
    while not is_over.is_set():
        source.stop()
        is_over.wait(_STOP_INTERVAL)
