"""Progress bars of a batch."""

from __future__ import annotations

import re
from io import StringIO
from pathlib import Path

import pytest
from helpers.batches import plan_seeds
from rich.console import Console
from rich.table import Table

from v3d_torch.batch.executor import JobFinished, JobProgress, JobRepeated
from v3d_torch.batch.progress import BatchProgress
from v3d_torch.evaluation.tables import Cell, ErrorTable
from v3d_torch.runs.progress_bar import ProgressBars, progress_bars


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


def table_of(rooms: int) -> ErrorTable:
    """Table of three configurations, whose cells have two lines."""
    cells = (Cell("0.1000 [0.0500-0.2000]", best=False),) * 3
    return ErrorTable("ATE, m", ("full", "paper", "baseline"), {f"room_{k}": cells for k in range(rooms)})


def drawn_lines(progress: ProgressBars) -> list[str]:
    """Lines that a refresh draws."""
    lines = progress.console.render_lines(progress.get_renderable())
    return ["".join(segment.text for segment in line) for line in lines]


def test_table_has_the_newest_rows_that_fit_below_the_bars(moment: Path, tmp_path: Path) -> None:
    jobs = plan_seeds(moment, tmp_path, seeds=4)
    with progress_bars(Console(force_terminal=True, width=100, height=30, file=StringIO())) as progress:
        show = BatchProgress(progress, jobs, jobs)
        for job in jobs[:2]:
            show(JobProgress(job, 1))
        show.show_table(table_of(3))
        assert re.findall(r"room_(\d+) ", "".join(drawn_lines(progress))) == ["0", "1", "2"]
        show.show_table(table_of(60))
        show(JobProgress(jobs[2], 1))  # the next job starts
        lines = drawn_lines(progress)
    rows = re.findall(r"room_(\d+) ", "".join(lines))
    assert 28 <= len(lines) <= 30 and len(rows) == 10
    assert rows == [str(k) for k in range(50, 60)] and any(line.strip() == "... 50 more" for line in lines)


def test_table_is_laid_out_once_and_drawn_twice_a_second(
    moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = plan_seeds(moment, tmp_path, seeds=1)
    with progress_bars(Console(force_terminal=True, width=100, height=30, file=StringIO())) as progress:
        assert progress.live.refresh_per_second == 2
        BatchProgress(progress, jobs, jobs).show_table(table_of(60))
        monkeypatch.setattr("v3d_torch.batch.progress.make_screen_table", None)  # drawing does not call it
        assert any("room_59" in line for line in drawn_lines(progress))


@pytest.mark.parametrize("height", [1, 2, 5])
def test_table_on_a_low_screen_has_the_newest_row(height: int, moment: Path, tmp_path: Path) -> None:
    jobs = plan_seeds(moment, tmp_path, seeds=1)
    with progress_bars(Console(force_terminal=True, width=100, height=height, file=StringIO())) as progress:
        BatchProgress(progress, jobs, jobs).show_table(table_of(60))
        assert re.findall(r"room_(\d+) ", "".join(drawn_lines(progress))) == ["59"]
