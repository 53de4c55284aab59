"""Progress bars of a batch, and the table below them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.progress import TaskID
from rich.segment import Segment, Segments

from v3d_torch.batch.executor import BatchEvent, JobFinished, JobProgress
from v3d_torch.batch.job import Job
from v3d_torch.evaluation.tables import ErrorTable, make_screen_table, select_last_rows
from v3d_torch.io.text import printable
from v3d_torch.runs.progress_bar import ProgressBars


class BatchProgress:
    """Progress bars of a batch: one for the frames of all jobs, below it one for each running job, then a table.

    Args:
        progress: Display to add the bars to.
        jobs: All jobs of the batch.
        missing: Jobs that have not ended in an earlier batch.
    """

    def __init__(self, progress: ProgressBars, jobs: Sequence[Job], missing: Sequence[Job]) -> None:
        self._progress = progress
        self._running: dict[Path, TaskID] = {}
        self._frames = {job.folder: job.frames for job in jobs} | {job.folder: 0 for job in missing}
        self._most_bars = 0
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

    def show_table(self, table: ErrorTable) -> None:
        """Show the last rows of a table that fit on the screen below the bars, until the next call.

        The table is laid out here and not each time that the screen is drawn.
        """
        self._most_bars = max(self._most_bars, len(self._progress.tasks) + 1)  # and that of the job that starts next
        height = self._progress.console.height - self._most_bars
        counts = range(1, min(len(table.rows), height) + 1)
        count = bisect_right(counts, height, key=lambda count: len(self._lay_out(table, count)))
        lines = self._lay_out(table, max(count, 1))
        self._progress.table = Segments([segment for line in lines for segment in (*line, Segment.line())])

    def _lay_out(self, table: ErrorTable, count: int) -> list[list[Segment]]:
        """Lay out the last rows of a table as lines of the screen."""
        return self._progress.console.render_lines(make_screen_table(select_last_rows(table, count)), pad=False)

    def _update_total(self) -> None:
        note = f"{self._ended} of {self._total} runs"
        self._progress.update(self._all_jobs, completed=sum(self._frames.values()), note=note)
