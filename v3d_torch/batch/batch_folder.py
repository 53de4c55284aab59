"""Folders of batches and ablation studies, which are recognised by their tables.

This file imports no library that is slow to load: `v3d-torch run` also checks its folder.
"""

from __future__ import annotations

from pathlib import Path

from v3d_torch.runs.file_names import RunFile

RUNS_TABLE = "runs.parquet"
"""Name of the table of the runs, which a batch writes before its first run."""

STUDY_TABLE = "ablation.csv"
"""Name of the table with all values, which an ablation study writes after its first run."""


def has_batch(folder: Path) -> bool:
    """Check whether a folder is that of a batch: it has the table of its runs from the start, or runs."""
    return (folder / RUNS_TABLE).is_file() or next(folder.glob(f"*/*/seed*/{RunFile.LOG}"), None) is not None


def has_study_only(folder: Path) -> bool:
    """Check whether a folder is that of an ablation study. A reproduction has both tables."""
    return (folder / STUDY_TABLE).is_file() and not (folder / RUNS_TABLE).is_file()


def describe_contents(folder: Path) -> str | None:
    """Return "a batch" or "an ablation study" if a folder is that of one, else None."""
    return "an ablation study" if has_study_only(folder) else "a batch" if (folder / RUNS_TABLE).is_file() else None
