"""Progress bars of jobs and of runs."""

from __future__ import annotations

import time
from collections.abc import Iterable
from threading import Event

from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from v3d_torch.frame_result import FrameResult
from v3d_torch.runs.run import describe_motion
from v3d_torch.types import RGBDFrame

_REFRESHES_PER_SECOND = 2
"""Rate at which bars are drawn: drawing takes processor time from the runs."""


class ProgressBars(Progress):
    """Progress bars above an optional table.

    Attributes:
        table: Table below the bars; None for none.
    """

    table: RenderableType | None = None

    def get_renderables(self) -> Iterable[RenderableType]:
        """Yield the bars, then the table: a table that is too long for the screen does not hide the bars."""
        yield from super().get_renderables()
        if self.table is not None:
            yield self.table


def progress_bars(console: Console) -> ProgressBars:
    """Return progress bars with counts, remaining time and a note; hidden if the console is not a terminal."""
    return ProgressBars(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        refresh_per_second=_REFRESHES_PER_SECOND,
        disable=not console.is_terminal,
    )


class ProgressBar:
    """Progress bar of a job that reports (done, total), such as a download.

    Args:
        progress: Progress bars of the console.
        description: Text to the left of the bar.
    """

    def __init__(self, progress: Progress, description: str) -> None:
        self._progress, self._description = progress, description
        self._task: TaskID | None = None

    def __call__(self, done: int, total: int | None) -> None:
        """Update the bar."""
        if self._task is None:
            self._task = self._progress.add_task(self._description, note="")
        self._progress.update(self._task, completed=done, total=total)


class TrackingBar:
    """Progress bar of a run: frame rate, tracking status and moving objects.

    Args:
        progress: Progress bars of the console.
        frames: Number of frames; None if it is not known.
        interrupted: Event that ends the run after the current frame.
        done: Number of frames that are already tracked.
        description: Text to the left of the bar.
    """

    def __init__(
        self, progress: Progress, frames: int | None, interrupted: Event, done: int = 0, description: str = "tracking"
    ) -> None:
        self._progress = progress
        self._interrupted = interrupted
        self._task = progress.add_task(description, total=frames, completed=done, note="starting")
        self._start: float | None = None
        self._frames = 0

    def __call__(self, frame: RGBDFrame, result: FrameResult) -> None:
        """Update the bar after a frame.

        Raises:
            KeyboardInterrupt: If the run is interrupted.
        """
        now, note = time.perf_counter(), f"{result.status.value}  {describe_motion(result)}"
        if self._start is None:
            self._start = now  # the first frame is not counted, because it waits for the network
        else:
            self._frames += 1
            note = f"{self._frames / (now - self._start):.1f} frames/s  {note}"
        self._progress.update(self._task, advance=1, note=note)
        if self._interrupted.is_set():
            raise KeyboardInterrupt
