"""Execution of one job, in the process and on the machine to which it was sent."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.errors import DepthScaleWarning, GroundTruthWarning, InputError
from v3d_torch.frame_result import FrameResult
from v3d_torch.io.text import describe_error
from v3d_torch.pipeline import FrameCallback
from v3d_torch.runs.checkpoint import Checkpoint, describe_change, read_checkpoint
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.log import log_to
from v3d_torch.runs.request import CHANGEABLE
from v3d_torch.runs.result_folder import clear_earlier_results, lock_results
from v3d_torch.runs.run import Run
from v3d_torch.segmentation import make_segmenter
from v3d_torch.types import RGBDFrame


def run_job(job: Job, report_progress: Callable[[int], None]) -> str | None:
    """Run a sequence and write its log and results; resume from a checkpoint if the same run was killed before.

    Args:
        job: Job to run.
        report_progress: Called after each frame with the number of frames processed. A KeyboardInterrupt raised in it
            ends the run; the results so far are written.

    Returns:
        Error message of the run; None if it succeeded.
    """

    def on_frame(frame: RGBDFrame, result: FrameResult) -> None:
        report_progress(frame.index + 1)

    try:
        with lock_results(job.folder):
            return _run(job, on_frame)
    except Exception as error:  # continue the batch after an error in one run; its log has the traceback
        return describe_error(error)


def _run(job: Job, on_frame: FrameCallback) -> str | None:
    """Run a sequence in a folder to which no other run writes; return the error message of the run."""
    checkpoint = _matching_checkpoint(job)
    if checkpoint is None:
        clear_earlier_results(job.folder)
    with log_to(job.folder / RunFile.LOG, append=checkpoint is not None):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GroundTruthWarning)  # in the diagnosis of the run
            warnings.simplefilter("ignore", DepthScaleWarning)  # in the log of the run
            sequence = job.request.load_sequence()
        if checkpoint is not None and describe_change(checkpoint, sequence) is not None:
            clear_earlier_results(job.folder)
            checkpoint = None
        segment = make_segmenter(job.config, sequence.camera)
        run = Run(job.request, sequence, segment, job.folder, checkpoint=checkpoint)
        run(on_frame)
    return run.pipeline.record.failure


def _matching_checkpoint(job: Job) -> Checkpoint | None:
    """Return the checkpoint of the same run, whose sequence may have been moved; None if there is none to read."""
    try:
        checkpoint = read_checkpoint(job.folder)
    except InputError:
        return None
    request, wanted = checkpoint.request, job.request
    changed = {name: getattr(wanted, name) for name in CHANGEABLE}
    same = replace(request, config=single_threaded(request.config), **changed) == replace(
        wanted, config=single_threaded(wanted.config)
    )
    return checkpoint if same else None
