"""A job carried out, wherever that is."""

from __future__ import annotations

import warnings
from collections.abc import Callable

from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.datasets import load_sequence
from v3d_torch.errors import GroundTruthWarning, InputError, V3DError
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.runs.checkpoint import Checkpoint, describe_change, read_checkpoint
from v3d_torch.runs.logged_run import log_to, run_logged
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_folder import prepare_folder
from v3d_torch.segmentation import make_segmenter
from v3d_torch.types import RGBDFrame, TrackingStatus


def run_job(job: Job, report: Callable[[int], None]) -> str | None:
    """Run a sequence and write its log and its results. Where it was killed before, it goes on from its checkpoint.

    Args:
        job: to be carried out.
        report: called after each frame with the number of frames done; a KeyboardInterrupt out of it ends the run,
            with the results until then written.

    Returns:
        The sentence that the run failed with; None where it did not.
    """

    def on_frame(frame: RGBDFrame, scene: FrameObjects, status: TrackingStatus) -> None:
        report(frame.index + 1)

    try:
        checkpoint = _checkpoint(job)
        if checkpoint is None:
            prepare_folder(job.folder)
        with log_to(job.folder / "run.log", append=checkpoint is not None):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GroundTruthWarning)  # the run ends with that sentence
                sequence = load_sequence(job.source, data_root=job.data_root)
            if checkpoint is not None and describe_change(checkpoint, sequence) is not None:
                prepare_folder(job.folder)
                checkpoint = None
            segment = make_segmenter(job.config.segmentation)
            pipeline, _ = run_logged(
                sequence, segment, job.config, job.folder, on_frame, request=_request(job), checkpoint=checkpoint
            )
    except Exception as error:  # a run that breaks must not cost the others; its log has the traceback
        return sentence(error)
    return pipeline.record.failure


def _request(job: Job) -> RunRequest:
    return RunRequest(job.source, data_root=None if job.data_root is None else str(job.data_root))


def _checkpoint(job: Job) -> Checkpoint | None:
    """Of the same run, begun earlier; None where there is none that is whole: then it begins anew."""
    try:
        checkpoint = read_checkpoint(job.folder)
    except InputError:
        return None
    same = checkpoint.request == _request(job).absolute() and single_threaded(checkpoint.config) == single_threaded(
        job.config
    )
    return checkpoint if same else None


def sentence(error: Exception) -> str:
    """What an error says in one line; an error in the program says its type, too."""
    said = " ".join(str(error).split())
    return said if isinstance(error, V3DError) else f"{type(error).__name__}: {said}"
