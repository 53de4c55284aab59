"""Table of the runs of a batch."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pyarrow.parquet as pq

import v3d_torch
from v3d_torch.batch.batch_record import BatchRecord, write_runs
from v3d_torch.batch.executor import JobFinished
from v3d_torch.batch.job import Job
from v3d_torch.config import Config
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.io.files import write_text
from v3d_torch.runs.request import RunRequest

RESULTS_PAGE = Path(v3d_torch.__file__).parents[1] / "docs" / "results.md"


def test_documentation_lists_every_column_of_the_table_of_runs(tmp_path: Path) -> None:
    write_runs(tmp_path / "runs.parquet", [])
    columns = pq.read_table(tmp_path / "runs.parquet").column_names
    table = RESULTS_PAGE.read_text(encoding="utf-8").partition("| column of `runs.parquet` |")[2].partition("\n\n")[0]
    listed = [name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[1])]
    assert sorted(listed) == sorted(columns)


def test_table_of_runs_has_each_warning_in_its_own_line(tmp_path: Path) -> None:
    job = Job("room", 1, "", "full", RunRequest("room", Config()), tmp_path / "room" / "full" / "seed0")
    metrics = {"warnings": ["the depth seems to be late", "red and blue seem to be swapped"]}
    write_runs(tmp_path / "runs.parquet", [(job, Outcome("room", "full", 0, metrics)), (job, job.make_outcome("lost"))])
    written = pq.read_table(tmp_path / "runs.parquet")["warnings"].to_pylist()
    assert written == ["the depth seems to be late\nred and blue seem to be swapped", ""]


def test_sequence_of_the_newest_outcome_is_last(tmp_path: Path) -> None:
    jobs = [
        Job(name, 1, "", config, RunRequest(name, Config()), tmp_path / name / config / "seed0")
        for name in ("attic", "cellar", "hall")
        for config in ("full", "paper")
    ]
    record = BatchRecord(jobs, tmp_path)
    for job in (jobs[4], jobs[1], jobs[0], jobs[5]):
        record.add(JobFinished(job, "it broke"))
    newest_last = [(outcome.sequence, outcome.config) for outcome in record.outcomes_newest_last]
    assert newest_last == [("attic", "full"), ("attic", "paper"), ("hall", "full"), ("hall", "paper")]
    record.add(JobFinished(jobs[2], "it broke"))
    assert record.outcomes_newest_last[-1].sequence == "cellar"


def test_path_that_is_not_utf8_is_written_with_escapes(tmp_path: Path) -> None:
    """The error ended the whole batch."""
    job = Job("room", 1, "", "full", RunRequest("room", Config()), tmp_path / "room" / "full" / "seed0")
    failure = f"{os.fsdecode(b'v' + bytes([255]))}.png: is damaged"
    write_runs(tmp_path / "runs.parquet", [(job, job.make_outcome(failure))])
    assert pq.read_table(tmp_path / "runs.parquet")["failure"].to_pylist() == ["v\\udcff.png: is damaged"]
    write_text(tmp_path / "summary.md", failure)
    assert (tmp_path / "summary.md").read_text() == "v\\udcff.png: is damaged"
