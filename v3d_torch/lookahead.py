"""The next frame is looked at while this one is tracked."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial

import torch

from v3d_torch.datasets.stored import Following
from v3d_torch.mapping.recorder import Outlook
from v3d_torch.percept import Percept
from v3d_torch.second_process import SecondProcess
from v3d_torch.slam import V3DSLAM
from v3d_torch.timing import StageClock
from v3d_torch.types import RGBDFrame

_WORTH = 150
"""Frames for which a second process is begun: fewer are done soon after it is up, which takes some seconds."""


def percepts(frames: Iterator[RGBDFrame], slam: V3DSLAM, *, ahead: bool) -> Generator[Percept]:
    """What the frames show, for `V3DSLAM.take_in`, one after the other.

    Each frame is looked at with what was known of the camera when the one before it came, not when it was done with:
    so it makes no difference to the results whether that happens ahead, in another thread or another process.

    Args:
        frames: to be read.
        slam: that looks at them, and takes each in before it asks for the next.
        ahead: whether the next frame is read and looked at while one is taken in. Of a stored sequence that is long
            enough, a second process does that as soon as it is up, until then a thread.

    Raises:
        V3DError: a frame cannot be read; those before have been given.
    """
    look = partial(_look, frames, slam, torch.is_inference_mode_enabled())
    with ExitStack() as stack:
        if ahead and isinstance(frames, Following) and frames.left >= _WORTH and _cores() > 1:
            second = stack.enter_context(closing(SecondProcess(slam, frames.sequence)))
            look = partial(_look_there, second, frames, look)
        thread = stack.enter_context(ThreadPoolExecutor(1, "perception"))

        def begin() -> Callable[[], Percept | None]:
            outlook = slam.next_outlook
            return thread.submit(look, outlook).result if ahead else partial(look, outlook)

        upcoming = begin()
        while (percept := upcoming()) is not None:
            slam.next_outlook = slam.outlook()
            upcoming = begin()
            yield percept


def _look(frames: Iterator[RGBDFrame], slam: V3DSLAM, inference: bool, outlook: Outlook | None) -> Percept | None:
    """Read the next frame and look at it, here; None behind the last. ``inference`` tells whether without gradients."""
    clock = StageClock()
    with clock("read"):
        frame = next(frames, None)
    if frame is None:
        return None
    with torch.inference_mode(inference):
        percept = slam.perceive(frame, outlook)
    return replace(percept, seconds={**clock.seconds, **percept.seconds})


def _look_there(
    second: SecondProcess,
    frames: Following,
    look_here: Callable[[Outlook | None], Percept | None],
    outlook: Outlook | None,
) -> Percept | None:
    """Let the second process do that, as soon as it is up and as long as it can."""
    percept = second.look(frames.index, outlook) if frames.left else None
    if percept is None:
        return look_here(outlook)
    frames.index += 1
    return percept


def _cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
