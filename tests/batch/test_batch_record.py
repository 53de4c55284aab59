"""Table of the runs of a batch."""

from __future__ import annotations

import re
from pathlib import Path

import pyarrow.parquet as pq

import v3d_torch
from v3d_torch.batch.batch_record import write_runs

RESULTS_PAGE = Path(v3d_torch.__file__).parents[1] / "docs" / "results.md"


def test_documentation_lists_every_column_of_the_table_of_runs(tmp_path: Path) -> None:
    write_runs(tmp_path / "runs.parquet", [])
    columns = pq.read_table(tmp_path / "runs.parquet").column_names
    table = RESULTS_PAGE.read_text(encoding="utf-8").partition("| column of `runs.parquet` |")[2].partition("\n\n")[0]
    listed = [name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[1])]
    assert sorted(listed) == sorted(columns)
