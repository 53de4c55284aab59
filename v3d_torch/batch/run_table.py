"""The table of a batch: a row for each run that has ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from v3d_torch.batch.job import Job
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.io.files import atomic_write
from v3d_torch.types import TrackingStatus

FIGURES: Mapping[str, pa.DataType] = {
    **dict.fromkeys(("frames", "processed", *TrackingStatus, "keyframes", "loops"), pa.int64()),
    **dict.fromkeys(("coverage", "ate.rmse", "ate.std"), pa.float64()),
    **dict.fromkeys(("rpe.trans.rmse", "rpe.trans.std", "rpe.rot.rmse", "rpe.rot.std"), pa.float64()),
    **dict.fromkeys(("masks.moving_left_out", "masks.static_left_out"), pa.float64()),
    **dict.fromkeys(("masks.id_changes_per_60_frames", "masks.people_found"), pa.float64()),
    **dict.fromkeys(("fps", "seconds", "peak_memory_mb"), pa.float64()),
}
"""Type of each figure by its place in ``metrics.json``; the column is called so with ``_`` for the dots."""

_SCHEMA = pa.schema(
    [
        ("sequence", pa.string()),
        ("config", pa.string()),
        ("seed", pa.int64()),
        *((place.replace(".", "_"), kind) for place, kind in FIGURES.items()),
        ("failure", pa.string()),
        ("path", pa.string()),
    ]
)


def write_runs(path: Path, runs: Sequence[tuple[Job, Outcome]]) -> None:
    """Write a row for each run, whole or not at all; one that failed has no figures.

    Args:
        path: of the Parquet file. The column ``path`` is relative to its folder, which may be moved.
        runs: and what they gave.

    Raises:
        OutputError: when the folder cannot be written or the disk is full.
    """
    rows = [_row(job, outcome, path.parent) for job, outcome in runs]
    with atomic_write(path) as temporary:
        pq.write_table(pa.Table.from_pylist(rows, schema=_SCHEMA), temporary)


def _row(job: Job, outcome: Outcome, folder: Path) -> dict[str, object]:
    return {
        "sequence": outcome.sequence,
        "config": outcome.config,
        "seed": outcome.seed,
        **{place.replace(".", "_"): outcome.figure(place) for place in FIGURES},
        "failure": outcome.failure,
        "path": job.folder.relative_to(folder).as_posix(),
    }
