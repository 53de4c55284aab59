"""One run of a batch: what it takes in, how it is configured, where its results go."""

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


@dataclass(frozen=True)
class Job:
    """One run. It can be sent to another process or machine.

    Attributes:
        sequence: name for tables.
        source: what `load_sequence` opens, a path or a name.
        frames: of the sequence.
        data_root: where named sequences are kept.
        config_name: name of the configuration for tables.
        config: with its seed.
        folder: for the results.
    """

    sequence: str
    source: str
    frames: int
    data_root: Path | None
    config_name: str
    config: Config
    folder: Path

    def __str__(self) -> str:
        """One line for whoever waits."""
        return f"{self.sequence}, {self.config_name}, seed {self.config.seed}"

    def outcome(self, failure: str | None) -> Outcome:
        """What a run that has ended gave.

        Args:
            failure: that it ended with, by what its executor says.
        """
        metrics = self._metrics()
        if failure is None and metrics is None:
            failure = f"{self.folder}: holds no metrics.json; it has to be a folder that all machines share"
        given = metrics if failure is None and metrics is not None else {}  # of half a trajectory no score is taken
        return Outcome(self.sequence, self.config_name, self.config.seed, given, failure)

    def finished(self) -> Outcome | None:
        """What an earlier run in the folder gave, where it came to its end.

        Raises:
            InputError: it came to its end with another configuration.
        """
        metrics = self._metrics()
        if metrics is None or metrics.get("failure") is not None or metrics.get("processed") != self.frames:
            return None
        try:
            config = load_config(self.folder / "config.yaml")
        except ConfigError:
            config = None
        if config is None or single_threaded(config) != single_threaded(self.config):
            raise InputError(
                f"{self.folder}: is a finished run with other values than {self.config_name} has now; choose another"
                " folder with --out, or delete it to run it again"
            )
        return self.outcome(None)

    def _metrics(self) -> Mapping[str, Any] | None:
        try:
            metrics = json.loads((self.folder / "metrics.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        return metrics if isinstance(metrics, dict) else None


def single_threaded(config: Config) -> Config:
    """The same configuration on one thread, which changes the time and nothing else."""
    segmentation = config.segmentation.model_copy(update={"threads": 1})
    return config.model_copy(update={"threads": 1, "prefetch": False, "segmentation": segmentation})
