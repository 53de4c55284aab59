"""A run with its log and its results, whoever watches it."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from collections.abc import Iterator, Sized
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

from v3d_torch.config import Config
from v3d_torch.config.loading import dump_config
from v3d_torch.datasets import RGBDStream
from v3d_torch.errors import OutputError
from v3d_torch.evaluation import Evaluation
from v3d_torch.io.files import write_text
from v3d_torch.mapping.map_io import StoredMap
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.pipeline import FrameCallback, Pipeline
from v3d_torch.runs.autosave import Autosave
from v3d_torch.runs.checkpoint import Checkpoint, restore
from v3d_torch.runs.numerics_check import CheckedSLAM
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_folder import remove_unfinished
from v3d_torch.runs.results import write_results
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation.coco import class_name
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, Segmenter, TrackingStatus
from v3d_torch.viz.viewer import NULL_VIEWER, Viewer

_LOG = logging.getLogger("v3d_torch")


def run_logged(
    sequence: RGBDStream,
    segment: Segmenter,
    config: Config,
    folder: Path,
    on_frame: FrameCallback,
    *,
    save_masks: bool = False,
    viewer: Viewer = NULL_VIEWER,
    known: StoredMap | None = None,
    request: RunRequest | None = None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Pipeline, Evaluation | None]:
    """Run a sequence through a new system, note each frame in the log (`log_to`), and write all results.

    Args:
        sequence: frames.
        segment: gives the instances of a frame.
        config: of the system.
        folder: for the results, there already.
        on_frame: called after each frame; a KeyboardInterrupt out of it ends the run between two frames.
        save_masks: whether to write what is left out of tracking.
        viewer: looks on.
        known: map to find the camera in.
        request: what was asked of the run, for whoever goes on with it; None for no checkpoints.
        checkpoint: of the run, with the same sequence, to go on from; None to begin.

    Returns:
        What ran, to the end or until its ``run.failure``, and the scores where there is ground truth.

    Raises:
        OutputError: when the results cannot be written.
    """
    write_text(folder / "config.yaml", dump_config(config))  # where this has no room, an hour's results have none
    set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    masks = folder / "masks" if save_masks else None
    system = CheckedSLAM if config.check_numerics else V3DSLAM
    slam = system(sequence.camera, segment, config, None if known is None else known.map)
    pipeline = Pipeline(sequence, slam, masks, viewer, None if known is None else known.views)
    if checkpoint is not None:
        remove_unfinished(folder)
        restore(pipeline, checkpoint)
        _LOG.info("goes on after %d frames", checkpoint.frames)
    autosave = Autosave(folder, pipeline, request)
    _LOG.info("%s: %s frames", sequence.name, len(sequence) if isinstance(sequence, Sized) else "any number of")

    def note(frame: RGBDFrame, scene: FrameObjects, status: TrackingStatus) -> None:
        moves = describe_motion(scene) or "nothing moves"
        _LOG.info("frame %d at %.6f: %s; %s", frame.index, frame.stamp, status.value, moves)
        autosave()
        on_frame(frame, scene, status)

    run = pipeline(note)
    autosave.end()
    pipeline.flush()
    evaluation = write_results(folder, pipeline)
    autosave.discard()
    if run.failure:
        _LOG.error(run.failure)
    return pipeline, evaluation


def describe_motion(scene: FrameObjects) -> str:
    """The objects that do not stand still, by class and verdict; empty when there are none."""
    verdicts = Counter(f"{class_name(judged.label)} {judged.motion_state.value}" for judged in scene.objects)
    return ", ".join(f"{count} {what}" for what, count in sorted(verdicts.items()) if "static" not in what)


@contextmanager
def log_to(path: Path, *, append: bool = False) -> Iterator[None]:
    """Write the package's log to a new file, or go on with one; an error that leaves the block is in it, traceback too.

    Raises:
        OutputError: when the file cannot be written.
    """
    try:
        if not append:
            path.write_text("")
        # Appended to: what the interpreter itself says of a crash may go to the same file.
        handler = _LogFile(path, mode="a", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another folder with --out") from error
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    _LOG.addHandler(handler)
    _LOG.setLevel(logging.INFO)
    _LOG.propagate = False
    try:
        yield
    except Exception:
        _LOG.exception("the run broke")
        raise
    finally:
        _LOG.removeHandler(handler)
        handler.close()


class _LogFile(logging.FileHandler):
    """A disk that is full ends the log, not the run: the results come to tell."""

    def handleError(self, record: logging.LogRecord) -> None:
        if not isinstance(sys.exception(), OSError):
            super().handleError(record)

    def close(self) -> None:
        with suppress(OSError):
            super().close()
