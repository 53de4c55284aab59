"""The next frame is looked at while this one is tracked."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

from v3d_torch.mapping.recorder import Outlook
from v3d_torch.percept import Percept
from v3d_torch.slam import V3DSLAM
from v3d_torch.timing import StageClock
from v3d_torch.types import RGBDFrame


def percepts(frames: Iterator[RGBDFrame], slam: V3DSLAM, *, ahead: bool) -> Generator[Percept]:
    """What the frames show, for `V3DSLAM.take_in`, one after the other.

    Each frame is looked at with what was known of the camera when the one before it came, not when it was done with:
    so it makes no difference to the results whether that happens ahead, in another thread.

    Args:
        frames: to be read.
        slam: that looks at them, and takes each in before it asks for the next.
        ahead: whether the next frame is read and looked at while one is taken in.

    Raises:
        V3DError: a frame cannot be read; those before have been given.
    """

    def look(outlook: Outlook | None) -> Percept | None:
        clock = StageClock()
        with clock("read"):
            frame = next(frames, None)
        if frame is None:
            return None
        percept = slam.perceive(frame, outlook)
        return replace(percept, seconds={**clock.seconds, **percept.seconds})

    with ThreadPoolExecutor(1, "perception") as thread:

        def begin() -> Callable[[], Percept | None]:
            outlook = slam.next_outlook
            return thread.submit(look, outlook).result if ahead else partial(look, outlook)

        upcoming = begin()
        while (percept := upcoming()) is not None:
            slam.next_outlook = slam.outlook()
            upcoming = begin()
            yield percept
