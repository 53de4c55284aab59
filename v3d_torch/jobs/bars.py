"""How far a batch is, for whoever watches."""

from __future__ import annotations

from pathlib import Path

from rich.markup import escape
from rich.progress import Progress, TaskID

from v3d_torch.jobs.executor import Advanced, Ended


class Bars:
    """A bar for each run that is under way, below one for all runs.

    Args:
        progress: that shows them.
        total: number of runs.
        done: of these, before this batch.
    """

    def __init__(self, progress: Progress, total: int, done: int) -> None:
        self._progress = progress
        self._tasks: dict[Path, TaskID] = {}
        self._all = progress.add_task("all runs", total=total, completed=done, note="")

    def __call__(self, event: Advanced | Ended) -> None:
        """Show what has happened."""
        job = event.job
        if isinstance(event, Advanced):
            if job.folder not in self._tasks:
                self._tasks[job.folder] = self._progress.add_task(escape(str(job)), total=job.frames, note="")
            self._progress.update(self._tasks[job.folder], completed=event.frames)
        else:
            if job.folder in self._tasks:
                self._progress.remove_task(self._tasks.pop(job.folder))
            self._progress.update(self._all, advance=1)
