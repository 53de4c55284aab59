"""Table of the time that each stage of a frame took, as ``--profile`` shows it."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from v3d_torch.pipeline import RunRecord


def stage_table(run: RunRecord) -> Table:
    """Return the milliseconds per frame of each stage; a stage counts as 0 on frames on which it did not run.

    Args:
        run: Record of a finished run with at least one frame.
    """
    stages = list(dict.fromkeys(name for row in run.frames for name in row if name not in ("frame", "stamp")))
    times = 1e3 * np.array([[row.get(stage, 0.0) for stage in stages] for row in run.frames])  # frames x stages, ms
    totals = times.sum(axis=1)
    table = Table(title="time per frame, ms", show_footer=True)
    columns = zip(("stage", "mean", "median", "95%", "fraction"), ("all", *_summary(totals, totals)), strict=True)
    for heading, total in columns:
        table.add_column(heading, footer=total, justify="left" if heading == "stage" else "right")
    for stage, column in zip(stages, times.T, strict=True):
        table.add_row(stage, *_summary(column, totals))
    table.caption = f"{1e3 * run.seconds / len(run.frames):.1f} ms of wall time, because stages overlap"
    return table


def _summary(times: np.ndarray, totals: np.ndarray) -> tuple[str, str, str, str]:
    mean, median, percentile = times.mean(), np.median(times), np.quantile(times, 0.95)
    return f"{mean:.1f}", f"{median:.1f}", f"{percentile:.1f}", f"{times.sum() / totals.sum():.0%}"
