"""What the runs of a batch gave so far, in memory and on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from v3d_torch.batch.executor import Finished
from v3d_torch.batch.job import Job
from v3d_torch.batch.run_table import write_runs
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.evaluation.summary import csv_text, latex, markdown, screen_tables
from v3d_torch.io.files import write_text


class BatchRecord:
    """The outcomes of a batch, those of earlier batches that were finished among them.

    Args:
        jobs: all runs.
        folder: of the batch's results.

    Raises:
        InputError: a finished run in the folder has another configuration.
    """

    def __init__(self, jobs: Sequence[Job], folder: Path) -> None:
        self.jobs = jobs
        self.folder = folder
        self._outcomes = {job.folder: outcome for job in jobs if (outcome := job.finished()) is not None}

    @property
    def outcomes(self) -> list[Outcome]:
        """Of the runs that have ended, in the order of the jobs."""
        return [self._outcomes[job.folder] for job in self.jobs if job.folder in self._outcomes]

    @property
    def failed(self) -> list[Outcome]:
        """Of the runs that have failed."""
        return [outcome for outcome in self.outcomes if outcome.failure is not None]

    @property
    def missing(self) -> list[Job]:
        """Jobs that have not ended."""
        return [job for job in self.jobs if job.folder not in self._outcomes]

    def add(self, event: Finished) -> Outcome:
        """Take in a run that has ended."""
        outcome = self._outcomes[event.job.folder] = event.job.outcome(event.failure)
        return outcome

    def write(self) -> None:
        """Write the table of the runs and the summaries.

        Raises:
            OutputError: when the folder cannot be written or the disk is full.
        """
        ended = [(job, self._outcomes[job.folder]) for job in self.jobs if job.folder in self._outcomes]
        write_runs(self.folder / "runs.parquet", ended)
        self.summarise()

    def summarise(self) -> None:
        """Write the summaries alone; errors as `write`."""
        write_text(self.folder / "summary.md", markdown(self.outcomes))
        write_text(self.folder / "summary.tex", latex(self.outcomes))
        write_text(self.folder / "summary.csv", csv_text(self.outcomes))

    def tables(self) -> list[Table]:
        """The summary for the screen."""
        return screen_tables(self.outcomes)
