"""Runner of a batch: display of the runs that end."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from io import StringIO
from pathlib import Path
from threading import Event

import pytest
from helpers.batches import plan_seeds
from rich.console import Console

from v3d_torch.batch.batch_record import BatchRecord
from v3d_torch.batch.executor import JobFinished
from v3d_torch.batch.job import Job
from v3d_torch.batch.runner import run_missing_jobs
from v3d_torch.errors import RunError
from v3d_torch.evaluation.tables import ErrorTable


def fail_all(jobs: Sequence[Job], stop: Event) -> Generator[JobFinished]:
    """Executor whose jobs all fail."""
    for job in jobs:
        yield JobFinished(job, f"{job}: it broke")


class CountedRecord(BatchRecord):
    """Record that counts its live tables."""

    tables_made = 0

    def progress_table(self) -> ErrorTable | None:
        self.tables_made += 1
        return super().progress_table()


@pytest.mark.parametrize("is_terminal", [False, True])
def test_progress_table_is_made_for_a_terminal_only(is_terminal: bool, moment: Path, tmp_path: Path) -> None:
    record = CountedRecord(plan_seeds(moment, tmp_path, seeds=3), tmp_path)
    with pytest.raises(RunError, match=r"^3 of 3 runs failed; .* to run them again$"):
        run_missing_jobs(record, fail_all, Console(file=StringIO(), force_terminal=is_terminal), resume=False)
    assert record.tables_made == 3 * is_terminal
