"""What a run has so far is written while it goes, so that little is lost when it is killed."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path

from v3d_torch.errors import OutputError
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.checkpoint import CHECKPOINT, write_checkpoint
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.results import write_intermediate_results

_LOG = logging.getLogger(__name__)


class Autosave:
    """Writes results and checkpoints, as often as the configuration says.

    Where they cannot be written the run goes on, and ``run.unsaved`` says why; it may end better.

    Args:
        folder: of the results.
        pipeline: that runs.
        request: what was asked of the run; None where nobody would go on with it: then there are no checkpoints.
    """

    def __init__(self, folder: Path, pipeline: Pipeline, request: RunRequest | None) -> None:
        self._folder = folder
        self._pipeline = pipeline
        self._request = request
        self._config = pipeline.slam.config.checkpoint
        self._due = time.perf_counter() + self._config.interval

    def __call__(self) -> None:
        """A frame is done: write what there is, if it is time."""
        begin = time.perf_counter()
        if begin < self._due:
            return
        try:
            write_intermediate_results(self._folder, self._pipeline)
            self._write_checkpoint()
        except OutputError as error:
            self._give_up(error)
        end = time.perf_counter()
        self._due = end + max(self._config.interval, (end - begin) * (1 / self._config.max_time_share - 1))

    def end(self) -> None:
        """The frames are over, before their results are written: where that was too early, write a last checkpoint.

        Of a frame that is half taken in there is none: the one before stays.
        """
        run = self._pipeline.record
        if (
            run.failure is None
            or not run.frames
            or not self._pipeline.between_frames
            or math.isinf(self._config.interval)
        ):
            return
        try:
            self._write_checkpoint()
        except OutputError as error:
            self._give_up(error)

    def discard(self) -> None:
        """The results are written: where they are those of the whole sequence, nobody goes on from here."""
        if self._pipeline.record.failure is None:
            (self._folder / CHECKPOINT).unlink(missing_ok=True)

    def _write_checkpoint(self) -> None:
        if self._request is None:
            return
        begin, path = time.perf_counter(), self._folder / CHECKPOINT
        write_checkpoint(self._folder, self._pipeline, self._request)
        seconds, size = time.perf_counter() - begin, path.stat().st_size / (1 << 20)
        _LOG.info("checkpoint after %d frames: %.1f MB in %.2f s", len(self._pipeline.record.frames), size, seconds)

    def _give_up(self, error: OutputError) -> None:
        self._pipeline.record.save_error = str(error)
        _LOG.warning("no checkpoint: %s", error)
