"""Periodic saving of results and checkpoints during a run."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from v3d_torch.datasets.base import LiveStream
from v3d_torch.errors import OutputError
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.checkpoint import FileSizes, write_checkpoint
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.segmentation_files import SegmentationFiles

_LOG = logging.getLogger(__name__)


class Autosave:
    """Saves results and checkpoints at the intervals of the configuration.

    Files of a live run are written in a thread, because frames are lost while tracking waits. If files cannot be
    written, the run continues, with the reason in ``record.save_error`` until they are written again.

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
        weights = None if request is None else request.weights
        self._segmentation = SegmentationFiles(weights, pipeline.slam.segment, pipeline.sequence)
        self._config = pipeline.slam.config.checkpoint
        self._due = time.perf_counter() + self._config.interval
        self._thread: ThreadPoolExecutor | None = None
        self._saved: Future[None] | None = None
        if isinstance(pipeline.sequence, LiveStream):
            _import_writer()  # takes a second, in which a camera that has started would lose frames
            self._thread = ThreadPoolExecutor(1, "autosave")
        self._logged_error = ""

    def __call__(self) -> None:
        """Save after a frame, if a save is due.

        Raises:
            Exception: The error of the program that ended the last save in the thread.
        """
        if self._saved is not None and self._saved.done():
            self._saved.result()
        start = time.perf_counter()
        if start < self._due:
            return
        self._due = math.inf  # until the files are written
        write = _import_writer()(self._folder, self._pipeline)
        if self._thread is None:
            self._save(write, start)
        else:
            self._saved = self._thread.submit(self._save, write, start)

    def end(self) -> None:
        """Save a last checkpoint if the run ended early between two frames, before the results are written.

        If the run ended within a frame, the last checkpoint stays: the state within a frame is not consistent.
        """
        if self._saved is not None and (error := self._saved.exception()) is not None:  # waits for the thread
            _LOG.error("autosave failed", exc_info=error)
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
            (self._folder / RunFile.CHECKPOINT).unlink(missing_ok=True)

    def _save(self, write: Callable[[], None], start: float) -> None:
        """Write results and checkpoint, and set the time of the next ones."""
        try:
            write()
            self._write_checkpoint()
        except OutputError as error:
            self._report(error)
        end = time.perf_counter()
        self._due = end + max(self._config.interval, (end - start) * (1 / self._config.max_time_fraction - 1))

    def _write_checkpoint(self) -> None:
        self._pipeline.record.save_error = None  # before the record is stored in the checkpoint
        if self._request is None:
            return
        start, path = time.perf_counter(), self._folder / RunFile.CHECKPOINT
        write_checkpoint(self._folder, self._pipeline, self._request, self._sizes, self._segmentation)
        seconds, size = time.perf_counter() - start, path.stat().st_size / 1e6
        _LOG.info("checkpoint after %d frames: %.1f MB in %.2f s", len(self._pipeline.record.times), size, seconds)

    def _report(self, error: OutputError) -> None:
        if self._logged_error != str(error):
            _LOG.warning("no checkpoint: %s", error)
        self._pipeline.record.save_error = self._logged_error = str(error)


def _import_writer() -> Callable[[Path, Pipeline], Callable[[], None]]:
    """Import the writer of results, whose libraries would delay the first frame."""
    from v3d_torch.runs.results import prepare_intermediate_results

    return prepare_intermediate_results
