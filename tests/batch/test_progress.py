"""Progress bars of a batch."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

from helpers.batches import plan_seeds
from rich.console import Console
from rich.table import Table

from v3d_torch.batch.executor import JobFinished, JobProgress, JobRepeated
from v3d_torch.batch.progress import BatchProgress
from v3d_torch.runs.progress_bar import progress_bars


def test_bars_show_all_running_jobs(moment: Path, tmp_path: Path) -> None:
    all_jobs = plan_seeds(moment, tmp_path, seeds=4)
    first, second = all_jobs[1:3]
    output = StringIO()
    screen = Console(force_terminal=True, width=100, file=output)
    with progress_bars(screen) as progress:
        show = BatchProgress(progress, all_jobs, all_jobs[1:])
        for event in (
            JobProgress(first, 0),
            JobProgress(second, 4),
            JobRepeated(second, "its machine died"),
            JobProgress(second, 1),
            JobProgress(first, 5),
            JobFinished(second, None),
        ):
            show(event)
        shown = {task.description: (task.completed, task.total) for task in progress.tasks}
        notes = [task.fields["note"] for task in progress.tasks]
        progress.table = Table("errors so far")
        progress.refresh()
        show(JobRepeated(first, "its machine died"))
        again = [(task.description, task.completed) for task in progress.tasks]
    assert "errors so far" in output.getvalue()
    assert shown == {"all runs": (6 + 5 + 6, 24), str(first): (5, 6)} and notes == ["2 of 4 runs", ""]
    assert again == [("all runs", 6 + 6)]
