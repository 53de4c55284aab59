"""A folder of results that is used again: nothing of the earlier run may be taken for the next one's."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from v3d_torch.errors import OutputError

_LOG = "run.log"

_WRITTEN = (
    *("trajectory.txt", "keyframes.txt", "config.yaml", "metrics.json", "dynamics.parquet", "map.ply", _LOG),
    *("figures/trajectory.png", "figures/masks.png", "masks/*.png"),
)
"""All that a run writes."""


def clear_results(folder: Path) -> None:
    """Remove what an earlier run has left in a folder; what else is there stays.

    Raises:
        OutputError: the folder holds something and no log of a run: it may be the user's own data, which has files of
            the same names; or it cannot be written.
    """
    try:
        if any(folder.iterdir()) and not (folder / _LOG).is_file():
            raise OutputError(f"{folder}: holds something that no run has left; choose a new folder with --out")
        for path in [path for pattern in _WRITTEN for path in folder.glob(pattern)]:
            path.unlink()
        for emptied in (folder / "figures", folder / "masks"):
            with suppress(OSError):  # not there, or with something else in it
                emptied.rmdir()
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written ({error.strerror}); choose another folder with --out"
        ) from error
