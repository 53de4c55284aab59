"""Execution of one job, in whatever process or machine it was sent to."""

from __future__ import annotations

import warnings
from collections.abc import Callable

from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.datasets import load_sequence
from v3d_torch.errors import GroundTruthWarning, InputError, V3DError
from v3d_torch.objects.motion_classifier import FrameObjects
from v3d_torch.runs.checkpoint import Checkpoint, describe_change, read_checkpoint
from v3d_torch.runs.logged_run import log_to, run_logged
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_folder import prepare_folder
from v3d_torch.segmentation import make_segmenter
from v3d_torch.types import RGBDFrame, TrackingStatus


def run_job(job: Job, report_progress: Callable[[int], None]) -> str | None:
    """Run a sequence and write its log and results; resume from a checkpoint if the same run was killed before.

    Args:
        job: Job to run.
        report_progress: Called after each frame with the number of frames processed. A KeyboardInterrupt raised in it
            ends the run; the results so far are written.

    Returns:
        Error message of the run; None if it succeeded.
    """

    def on_frame(frame: RGBDFrame, objects: FrameObjects, status: TrackingStatus) -> None:
        report_progress(frame.index + 1)

    try:
        checkpoint = _matching_checkpoint(job)
        if checkpoint is None:
            prepare_folder(job.folder)
        with log_to(job.folder / "run.log", append=checkpoint is not None):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GroundTruthWarning)  # reported as the failure of the run
                sequence = load_sequence(job.source, data_root=job.data_root)
            if checkpoint is not None and describe_change(checkpoint, sequence) is not None:
                prepare_folder(job.folder)
                checkpoint = None
            segment = make_segmenter(job.config.segmentation)
            pipeline, _ = run_logged(
                sequence, segment, job.config, job.folder, on_frame, request=_make_request(job), checkpoint=checkpoint
            )
    except Exception as error:  # an error in one run must not end the batch; its log has the traceback
        return describe_error(error)
    return pipeline.record.failure


def _make_request(job: Job) -> RunRequest:
    return RunRequest(job.source, data_root=None if job.data_root is None else str(job.data_root))


def _matching_checkpoint(job: Job) -> Checkpoint | None:
    """Return the checkpoint of the same run; None if there is no readable one, so that the run starts anew."""
    try:
        checkpoint = read_checkpoint(job.folder)
    except InputError:
        return None
    same = checkpoint.request == _make_request(job).absolute() and single_threaded(
        checkpoint.config
    ) == single_threaded(job.config)
    return checkpoint if same else None


def describe_error(error: Exception) -> str:
    """Return the message of an error on one line, with the type of the error unless it is a `V3DError`."""
    message = " ".join(str(error).split())
    return message if isinstance(error, V3DError) else f"{type(error).__name__}: {message}"
