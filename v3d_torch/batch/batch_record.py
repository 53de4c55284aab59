"""Outcomes of the runs of a batch, in memory and as tables on disk."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import RenderableType

from v3d_torch.batch.batch_folder import RUNS_TABLE
from v3d_torch.batch.executor import JobFinished
from v3d_torch.batch.job import Job
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.evaluation.summary import (
    format_csv,
    format_latex,
    format_markdown,
    make_progress_table,
    make_screen_tables,
)
from v3d_torch.evaluation.tables import ErrorTable
from v3d_torch.io.files import write_text
from v3d_torch.io.parquet_file import write_parquet
from v3d_torch.io.text import printable
from v3d_torch.types import TrackingStatus

METRIC_TYPES: Mapping[str, pa.DataType] = {
    **dict.fromkeys(("frames", "processed", "skipped", *TrackingStatus, "pairs"), pa.int64()),
    **dict.fromkeys(("keyframes", "landmarks", "loops"), pa.int64()),
    **dict.fromkeys(("coverage", "ate.rmse", "ate.std"), pa.float64()),
    **dict.fromkeys(("rpe.trans.rmse", "rpe.trans.std", "rpe.rot.rmse", "rpe.rot.std"), pa.float64()),
    **dict.fromkeys(("masks.moving_masked", "masks.static_masked"), pa.float64()),
    **dict.fromkeys(("masks.id_switches_per_60_frames", "masks.people_found"), pa.float64()),
    **dict.fromkeys(("readout", "readout_sigma"), pa.float64()),
    **dict.fromkeys(("fps", "seconds", "peak_memory_mb"), pa.float64()),
}
"""Metrics in ``runs.parquet`` by their key in ``metrics.json``, and their types.

The name of a column is the key with ``_`` instead of the dots.
"""

_SCHEMA = pa.schema(
    [
        ("sequence", pa.string()),
        ("config", pa.string()),
        ("seed", pa.int64()),
        *((key.replace(".", "_"), data_type) for key, data_type in METRIC_TYPES.items()),
        ("difference", pa.string()),
        ("warnings", pa.string()),
        ("failure", pa.string()),
        ("diagnosis", pa.string()),
        ("path", pa.string()),
    ]
)


class BatchRecord:
    """Outcomes of the jobs of a batch, including complete runs of earlier batches in the same folder.

    Args:
        jobs: All jobs of the batch.
        folder: Folder of the results.
        table_configs: Names of the configurations in the tables; None for all.
        absent: Sequences of the paper that are not available; they have a row without values in the tables.

    Raises:
        InputError: If a complete run in the folder has another configuration or another sequence.
    """

    def __init__(
        self,
        jobs: Sequence[Job],
        folder: Path,
        *,
        table_configs: Collection[str] | None = None,
        absent: Sequence[str] = (),
    ) -> None:
        self.jobs = jobs
        self.folder = folder
        self._table_configs = table_configs
        self._absent = absent
        self._table = folder / RUNS_TABLE
        self._outcomes = {job.folder: outcome for job in jobs if (outcome := job.earlier_outcome()) is not None}

    @property
    def outcomes(self) -> list[Outcome]:
        """Outcomes of the jobs that have ended, in the order of the jobs."""
        return [self._outcomes[job.folder] for job in self.jobs if job.folder in self._outcomes]

    @property
    def failed(self) -> list[Outcome]:
        """Outcomes of the jobs that have failed."""
        return [outcome for outcome in self.outcomes if outcome.failure is not None]

    @property
    def incomplete(self) -> list[Outcome]:
        """Outcomes of the jobs that have ended with incomplete results, such as no scores."""
        return [outcome for outcome in self.outcomes if outcome.failure is None and outcome.diagnosis is not None]

    @property
    def missing(self) -> list[Job]:
        """Jobs that have not ended."""
        return [job for job in self.jobs if job.folder not in self._outcomes]

    @property
    def unplanned(self) -> list[str]:
        """Folders of runs in the table of an earlier batch that are not jobs of this one, relative to the folder."""
        planned = {_relative_path(job, self.folder) for job in self.jobs}
        return [path for path in _read_paths(self._table) if path not in planned]

    def add(self, event: JobFinished) -> Outcome:
        """Store the outcome of a job that has ended, and return it."""
        outcome = self._outcomes[event.job.folder] = event.job.make_outcome(event.failure)
        return outcome

    def write(self) -> None:
        """Write ``runs.parquet`` and the summaries.

        Raises:
            OutputError: If the folder is not writable or the disk is full.
        """
        ended = [(job, self._outcomes[job.folder]) for job in self.jobs if job.folder in self._outcomes]
        write_runs(self._table, ended)
        self.write_summaries()

    def write_summaries(self) -> None:
        """Write the summaries only.

        Raises:
            OutputError: If the folder is not writable or the disk is full.
        """
        outcomes = self._table_outcomes
        write_text(self.folder / "summary.md", format_markdown(outcomes, self._absent))
        write_text(self.folder / "summary.tex", format_latex(outcomes, self._absent))
        write_text(self.folder / "summary.csv", format_csv(outcomes, self._absent))

    @property
    def _table_outcomes(self) -> list[Outcome]:
        """Outcomes in the tables."""
        configs = self._table_configs
        return [outcome for outcome in self.outcomes if configs is None or outcome.config in configs]

    @property
    def outcomes_newest_last(self) -> list[Outcome]:
        """Outcomes in the tables, those of the sequence of the newest one last."""
        ends = {outcome.sequence: end for end, outcome in enumerate(self._outcomes.values())}
        return sorted(self._table_outcomes, key=lambda outcome: ends[outcome.sequence])

    def progress_table(self) -> ErrorTable | None:
        """Return the table to show while jobs run, the newest rows last; None if there are no errors yet."""
        return make_progress_table(self.outcomes_newest_last)

    def screen_tables(self) -> list[RenderableType]:
        """Return the summary as tables for the screen, and their explanations."""
        return make_screen_tables(self._table_outcomes, self._absent)


def write_runs(path: Path, runs: Sequence[tuple[Job, Outcome]]) -> None:
    """Write a Parquet table with one row per run, atomically. The metrics of a failed run are empty.

    Args:
        path: Parquet file to write. The column ``path`` is relative to its folder, so that the folder can be moved.
        runs: Jobs and their outcomes.

    Raises:
        OutputError: If the folder is not writable or the disk is full.
    """
    rows = [_row(job, outcome, path.parent) for job, outcome in runs]
    write_parquet(path, pa.Table.from_pylist(rows, schema=_SCHEMA))


def _row(job: Job, outcome: Outcome, folder: Path) -> dict[str, object]:
    return {
        "sequence": outcome.sequence,
        "config": outcome.config,
        "seed": outcome.seed,
        **{key.replace(".", "_"): outcome.get_metric(key) for key in METRIC_TYPES},
        "difference": outcome.difference,
        "warnings": "\n".join(map(printable, outcome.warnings)),  # Parquet has no names that are not UTF-8
        "failure": None if outcome.failure is None else printable(outcome.failure),
        "diagnosis": None if outcome.diagnosis is None else printable(outcome.diagnosis),
        "path": _relative_path(job, folder),
    }


def _relative_path(job: Job, folder: Path) -> str:
    return job.folder.relative_to(folder).as_posix()


def _read_paths(table: Path) -> list[str]:
    """Read the column ``path`` of a table of runs; empty if there is no table that can be read."""
    try:
        paths: list[str] = pq.read_table(table, columns=["path"])["path"].to_pylist()
    except (OSError, pa.ArrowException, KeyError):
        return []
    return paths
