"""The file ``metrics.json`` of a run, and the search for the folder of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from v3d_torch.config.validation import first_error
from v3d_torch.errors import InputError
from v3d_torch.io.text_file import read_text
from v3d_torch.types import TrackingStatus

_MAX_DEPTH = 3
"""Maximum number of folder levels above a run: a batch has sequence, configuration and seed."""


class Metrics(BaseModel):
    """Values of ``metrics.json`` that later commands read, without the scores; field names are its keys."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    sequence: str
    frames: int = Field(ge=0)
    processed: int
    skipped: int = 0
    status: list[TrackingStatus]
    keyframes: int
    landmarks: int
    loops: int
    failure: str | None
    diagnosis: str | None = None
    difference: str | None = None
    sequence_digest: str | None = None
    warnings: list[str] = []
    pose_latency: dict[str, float] | None = None
    latency: dict[str, float] | None = None
    dropped: int = 0
    rejected: int = 0
    fps: float | None
    seconds: float
    seconds_per_stage: dict[str, float]
    peak_memory_mb: float | None
    seed: int
    masks: dict[str, Any] | None = None
    versions: dict[str, str | None]
    machine: dict[str, Any]

    @property
    def was_found(self) -> bool:
        """True if the camera was found in any frame."""
        return any(status is not TrackingStatus.LOST for status in self.status)


def read_metrics(path: Path) -> Metrics:
    """Read the ``metrics.json`` of a run.

    Raises:
        InputError: If it cannot be read, or was not written by a run of this version.
    """
    text = read_text(path, "it is written by a run")
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error}); run the sequence again") from error
    try:
        return Metrics.model_validate(tree)
    except ValidationError as error:
        raise InputError(
            f"{path}: {first_error(error)}; the file is from another version, run the sequence again"
        ) from error


def suggest_folder(path: Path, file: str) -> str | None:
    """Suggest a folder of a run: the folder of the given file, or the newest run below the given folder.

    Args:
        path: Path given by the user.
        file: Name of a file that the folder of a run has.

    Returns:
        Text of a suggestion, for error messages; None if there is no such folder.
    """
    if path.is_file() and (path.parent / file).is_file():
        return f"pass its folder, {path.parent}"
    found = [match for depth in range(1, _MAX_DEPTH + 1) for match in path.glob("*/" * depth + file)]
    if not found:
        return None
    # Prefer a link such as ``latest`` to the folder that it points to, because it is easier to type.
    newest = max(found, key=lambda match: (match.stat().st_mtime_ns, match.parent.is_symlink()))
    return f"pass the newest run in it, {newest.parent}"
