"""Table of the time of each stage of a frame, for ``--profile``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from v3d_torch.pipeline.run_record import RunRecord
from v3d_torch.runs.wall_time import describe_wall_time, do_stages_overlap

_CHAINS = {
    "features": ("read", "depth", "features"),
    "segmentation": ("segmentation",),
    "back end": ("bundle", "loop"),
}
"""Stages of each thread that runs in parallel with tracking, see `FramePrefetcher` and `BackEnd`; all other stages run
one after the other."""


def profile_table(run: RunRecord) -> Table:
    """Return the milliseconds per frame of each stage, and of each chain of stages that run one after the other.

    If stages overlap, the slowest chain limits the frame rate, independently of the number of processors. A stage that
    did not run on a frame counts as 0.

    Args:
        run: Record of a finished run with at least one frame.
    """
    stages, wall, cpu = run.times.stages, 1e3 * run.times.wall.numpy(), 1e3 * run.times.cpu.numpy()
    table = Table(title="time per frame, ms")
    for heading in ("stage", "wall", "median", "95%", "CPU", "fraction of CPU"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    for index, stage in enumerate(stages):
        table.add_row(stage, *_summary(wall[:, index], cpu[:, index], cpu.sum()))
    table.add_section()
    chains = {name: np.isin(stages, members) for name, members in _CHAINS.items()}
    chains["tracking"] = ~np.any(list(chains.values()), axis=0)
    for name, members in chains.items():
        summary = _summary(wall[:, members].sum(axis=1), cpu[:, members].sum(axis=1), cpu.sum())
        table.add_row(f"chain: {name}", *summary)
    table.add_section()
    table.add_row("all", *_summary(wall.sum(axis=1), cpu.sum(axis=1), cpu.sum()))
    slowest = max(chains, key=lambda name: wall[:, chains[name]].sum())
    stage_seconds = float(run.times.wall.sum())
    table.caption = describe_wall_time(stage_seconds, run.seconds, len(run.times))
    if do_stages_overlap(stage_seconds, run.seconds):
        table.caption += f"; the chain that limits the rate is {slowest}"
    return table


def _summary(wall: NDArray[np.float64], cpu: NDArray[np.float64], total: float) -> tuple[str, ...]:
    """Return mean, median and 95th percentile of the wall time, mean CPU time, and its fraction of the total."""
    percentile = np.quantile(wall, 0.95)
    fraction = cpu.sum() / total if total else 0.0
    return f"{wall.mean():.1f}", f"{np.median(wall):.1f}", f"{percentile:.1f}", f"{cpu.mean():.1f}", f"{fraction:.0%}"
