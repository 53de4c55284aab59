"""How far a batch is, for whoever watches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.progress import Progress, TaskID

from v3d_torch.batch.executor import Finished, JobProgress
from v3d_torch.batch.job import Job


class BatchProgress:
    """A bar for the frames of all runs, and below one for each run that is under way.

    Args:
        progress: that shows them.
        jobs: all runs.
        missing: those that have not ended before.
    """

    def __init__(self, progress: Progress, jobs: Sequence[Job], missing: Sequence[Job]) -> None:
        self._progress = progress
        self._tasks: dict[Path, TaskID] = {}
        self._frames = {job.folder: job.frames for job in jobs} | {job.folder: 0 for job in missing}
        self._ended, self._total = len(jobs) - len(missing), len(jobs)
        self._all = progress.add_task("all runs", total=sum(job.frames for job in jobs), note="")
        self._show()

    def __call__(self, event: JobProgress | Finished) -> None:
        """Show what has happened."""
        job = event.job
        if isinstance(event, JobProgress):
            if job.folder not in self._tasks:
                self._tasks[job.folder] = self._progress.add_task(escape(str(job)), total=job.frames, note="")
            self._frames[job.folder] = event.frames
            self._progress.update(self._tasks[job.folder], completed=event.frames)
        else:
            if job.folder in self._tasks:
                self._progress.remove_task(self._tasks.pop(job.folder))
            self._frames[job.folder] = job.frames
            self._ended += 1
        self._show()

    def _show(self) -> None:
        note = f"{self._ended} of {self._total} runs"
        self._progress.update(self._all, completed=sum(self._frames.values()), note=note)
