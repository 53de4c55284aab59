"""A folder of results that is used again: nothing of the earlier run may be taken for the next one's."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from v3d_torch.errors import OutputError

_LOG = "run.log"
"""Written anew by the next run, and before that the sign that a run made the rest."""

_WRITTEN = (
    *("trajectory.txt", "keyframes.txt", "groundtruth.txt", "config.yaml", "metrics.json", "report.html"),
    *("checkpoint.v3d", "frames.parquet", "dynamics.parquet", "map.ply", "mesh.ply", "trajectory.ply"),
    *("figures/trajectory.png", "figures/masks.png", "figures/voting.png", "figures/clusters.png", "masks/*.png"),
)
"""All else that a run, or the report of one, writes."""

_HALF_WRITTEN = (".*.part*", "figures/.*.part*", "masks/.*.part*")
"""Left where a run is killed while it writes."""


def prepare_folder(folder: Path) -> None:
    """Make a folder for the results of a run, and remove what an earlier run has left there; what else is there stays.

    Raises:
        OutputError: it has files of the same names and no log of a run, so they may be the user's own, such as the
            ground truth of a sequence; or it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        earlier = [path for pattern in (*_WRITTEN, *_HALF_WRITTEN) for path in sorted(folder.glob(pattern))]
        if earlier and not (folder / _LOG).is_file():
            raise OutputError(f"{earlier[0]}: is there and was left by no run; choose another folder with --out")
        for path in earlier:
            path.unlink()
        for emptied in (folder / "figures", folder / "masks"):
            with suppress(OSError):  # not there, or with something else in it
                emptied.rmdir()
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written ({error.strerror}); choose another folder with --out"
        ) from error


def remove_unfinished(folder: Path) -> None:
    """Remove what an earlier run was about to write when it was killed."""
    for pattern in _HALF_WRITTEN:
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)
