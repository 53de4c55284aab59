"""Atomic writing of Parquet files."""

from __future__ import annotations

import io
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from v3d_torch.io.files import atomic_write


def write_parquet(path: Path, table: pa.Table) -> None:
    """Write a table atomically.

    Args:
        path: Parquet file to write.
        table: Table.

    Raises:
        OutputError: If the folder is not writable or the disk is full.
    """
    content = io.BytesIO()  # so that Python, and not pyarrow, writes the file and raises the errors
    pq.write_table(table, content)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.getvalue())
