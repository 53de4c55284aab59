"""One run of a batch: its sequence, its configuration and the folder of its results."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.request import RunRequest


@dataclass(frozen=True)
class Job:
    """One run of a batch. Jobs can be pickled and sent to another process or machine.

    Attributes:
        sequence: Name of the sequence in tables.
        frames: Number of frames of the sequence.
        digest: Digest of the sequence, see `sequence_digest`.
        config_name: Name of the configuration in tables.
        request: Request of the run, independent of the machine's environment; its configuration includes the seed.
        folder: Folder of the results.
    """

    sequence: str
    frames: int
    digest: str
    config_name: str
    request: RunRequest
    folder: Path

    @property
    def config(self) -> Config:
        """Configuration of the run, including its seed."""
        return self.request.config

    def __str__(self) -> str:
        """Return a one-line description for the screen."""
        return f"{self.sequence}, {self.config_name}, seed {self.config.seed}"

    def make_outcome(self, failure: str | None) -> Outcome:
        """Return the outcome of the run that has just ended in the folder.

        Args:
            failure: Error message reported by the executor; None if the run succeeded.
        """
        metrics = self._read_metrics()
        if failure is None and metrics is None:
            failure = f"{self.folder}: contains no metrics.json; choose a folder that all machines share"
        # A failed run has no scores: its trajectory covers only a part of the sequence.
        scored = metrics if failure is None and metrics is not None else {}
        return Outcome(self.sequence, self.config_name, self.config.seed, scored, failure)

    def earlier_outcome(self) -> Outcome | None:
        """Return the outcome of an earlier, complete run in the folder; None if there is no such run.

        Raises:
            InputError: If the earlier run had another configuration, or another sequence of the same length.
        """
        metrics = self._read_metrics()
        if metrics is None or metrics.get("failure") is not None:
            return None
        if metrics.get("processed", 0) + metrics.get("skipped", 0) != self.frames:
            return None
        try:
            config = load_config(self.folder / RunFile.CONFIG)
        except ConfigError:
            config = None
        if config is None or single_threaded(config) != single_threaded(self.config):
            raise InputError(
                f"{self.folder}: contains a finished run with other values than those of {self.config_name}; choose"
                " another folder with --out, or delete this one to run it again"
            )
        if metrics.get("sequence_digest", self.digest) != self.digest:  # earlier versions stored no digest
            raise InputError(
                f"{self.folder}: contains a finished run with another camera, other timestamps or another ground truth"
                f" than {self.request.seq} has; choose another folder with --out, or delete this one to run it again"
            )
        return self.make_outcome(None)

    def _read_metrics(self) -> Mapping[str, Any] | None:
        try:
            metrics = json.loads((self.folder / RunFile.METRICS).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        return metrics if isinstance(metrics, dict) else None


def single_threaded(config: Config) -> Config:
    """Return the configuration with one thread, which changes run time but not results."""
    segmentation = config.segmentation.model_copy(update={"threads": 1})
    return config.model_copy(update={"threads": 1, "prefetch": False, "segmentation": segmentation})
