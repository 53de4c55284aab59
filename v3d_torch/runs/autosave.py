"""Periodic saving of results and checkpoints during a run."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path

from v3d_torch.errors import OutputError
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.checkpoint import CHECKPOINT, FileSizes, write_checkpoint
from v3d_torch.runs.request import RunRequest

_LOG = logging.getLogger(__name__)


class Autosave:
    """Saves results and checkpoints at the intervals of the configuration.

    If they cannot be written, the run continues, with the reason in ``record.save_error``.

    Args:
        folder: Folder of the results.
        pipeline: Pipeline that runs.
        request: Request of the run, stored in the checkpoints; None to save no checkpoints.
    """

    def __init__(self, folder: Path, pipeline: Pipeline, request: RunRequest | None) -> None:
        self._folder = folder
        self._pipeline = pipeline
        self._request = request
        self._sizes = FileSizes(pipeline.sequence)
        self._config = pipeline.slam.config.checkpoint
        self._due = time.perf_counter() + self._config.interval

    def __call__(self) -> None:
        """Save after a frame, if a save is due."""
        start = time.perf_counter()
        if start < self._due:
            return
        from v3d_torch.runs.results import write_intermediate_results  # pyarrow would delay the first frame

        try:
            write_intermediate_results(self._folder, self._pipeline)
            self._write_checkpoint()
        except OutputError as error:
            self._report(error)
        end = time.perf_counter()
        self._due = end + max(self._config.interval, (end - start) * (1 / self._config.max_time_fraction - 1))

    def end(self) -> None:
        """Save a last checkpoint if the run ended early between two frames, before the results are written.

        If the run ended within a frame, the last checkpoint stays: the state within a frame is not consistent.
        """
        record = self._pipeline.record
        if (
            record.failure is None
            or not record.times
            or not self._pipeline.between_frames
            or math.isinf(self._config.interval)
        ):
            return
        try:
            self._write_checkpoint()
        except OutputError as error:
            self._report(error)

    def discard(self) -> None:
        """Remove the checkpoint if the run reached the end of the sequence."""
        if self._pipeline.record.failure is None:
            (self._folder / CHECKPOINT).unlink(missing_ok=True)

    def _write_checkpoint(self) -> None:
        if self._request is None:
            return
        start, path = time.perf_counter(), self._folder / CHECKPOINT
        write_checkpoint(self._folder, self._pipeline, self._request, self._sizes)
        seconds, size = time.perf_counter() - start, path.stat().st_size / (1 << 20)
        _LOG.info("checkpoint after %d frames: %.1f MB in %.2f s", len(self._pipeline.record.times), size, seconds)

    def _report(self, error: OutputError) -> None:
        if self._pipeline.record.save_error != str(error):
            _LOG.warning("no checkpoint: %s", error)
        self._pipeline.record.save_error = str(error)
