"""What a frame took, stage by stage, as a table: what ``--profile`` shows."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from v3d_torch.pipeline import RunRecord


def stage_table(run: RunRecord) -> Table:
    """Milliseconds that each stage took; a frame on which a stage did not run counts as 0.

    Args:
        run: over, with at least one frame.
    """
    stages = list(dict.fromkeys(name for row in run.frames for name in row if name not in ("frame", "stamp")))
    taken = 1e3 * np.array([[row.get(stage, 0.0) for stage in stages] for row in run.frames])
    whole = taken.sum(axis=1)
    table = Table(title="milliseconds of a frame", show_footer=True)
    columns = zip(("stage", "mean", "median", "95%", "share"), ("all", *_figures(whole, whole)), strict=True)
    for name, together in columns:
        table.add_column(name, footer=together, justify="left" if name == "stage" else "right")
    for stage, column in zip(stages, taken.T, strict=True):
        table.add_row(stage, *_figures(column, whole))
    table.caption = f"{1e3 * run.seconds / len(run.frames):.1f} by the clock, where stages overlap"
    return table


def _figures(taken: np.ndarray, whole: np.ndarray) -> tuple[str, str, str, str]:
    mean, median, most = taken.mean(), np.median(taken), np.quantile(taken, 0.95)
    return f"{mean:.1f}", f"{median:.1f}", f"{most:.1f}", f"{taken.sum() / whole.sum():.0%}"
