"""Progress bars of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.progress import Progress, TaskID

from v3d_torch.batch.executor import BatchEvent, JobFinished, JobProgress
from v3d_torch.batch.job import Job
from v3d_torch.io.text import printable


class BatchProgress:
    """Progress bars of a batch: one for the frames of all jobs, and below it one for each running job.

    Args:
        progress: Display to add the bars to.
        jobs: All jobs of the batch.
        missing: Jobs that have not ended in an earlier batch.
    """

    def __init__(self, progress: Progress, jobs: Sequence[Job], missing: Sequence[Job]) -> None:
        self._progress = progress
        self._running: dict[Path, TaskID] = {}
        self._frames = {job.folder: job.frames for job in jobs} | {job.folder: 0 for job in missing}
        self._ended, self._total = len(jobs) - len(missing), len(jobs)
        self._all_jobs = progress.add_task("all runs", total=sum(job.frames for job in jobs), note="")
        self._update_total()

    def __call__(self, event: BatchEvent) -> None:
        """Show an event."""
        job = event.job
        if isinstance(event, JobProgress):
            if job.folder not in self._running:
                self._running[job.folder] = self._progress.add_task(escape(printable(job)), total=job.frames, note="")
            self._frames[job.folder] = event.frames
            self._progress.update(self._running[job.folder], completed=event.frames)
        else:
            if job.folder in self._running:
                self._progress.remove_task(self._running.pop(job.folder))
            has_ended = isinstance(event, JobFinished)
            self._frames[job.folder] = job.frames if has_ended else 0
            self._ended += has_ended
        self._update_total()

    def _update_total(self) -> None:
        note = f"{self._ended} of {self._total} runs"
        self._progress.update(self._all_jobs, completed=sum(self._frames.values()), note=note)
