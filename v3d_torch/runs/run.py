"""One run: processes a sequence with a new system, and writes log, checkpoints and results."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sized
from contextlib import suppress
from pathlib import Path

from v3d_torch.config import RollingShutterConfig
from v3d_torch.config.loading import dump_config
from v3d_torch.datasets import RGBDStream
from v3d_torch.datasets.image_sequence import ImageSequence
from v3d_torch.datasets.realtime_playback import stored_source
from v3d_torch.errors import OutputError
from v3d_torch.evaluation import Evaluation
from v3d_torch.frame_result import FrameResult
from v3d_torch.io.files import write_text
from v3d_torch.mapping.map_io import StoredMap, save_map
from v3d_torch.objects.frame_objects import FrameObjects, MotionState
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.pipeline import FrameCallback, Pipeline, Viewer
from v3d_torch.runs.autosave import Autosave
from v3d_torch.runs.checkpoint import Checkpoint
from v3d_torch.runs.file_names import MAP_MASKS, MASKS, RunFile
from v3d_torch.runs.map_file import check_map_path, is_map_file
from v3d_torch.runs.request import RunRequest, write_request
from v3d_torch.runs.result_folder import remove_unfinished
from v3d_torch.runs.system import make_system
from v3d_torch.segmentation.coco import class_name
from v3d_torch.types import RGBDFrame, Segmenter

_LOG = logging.getLogger(__name__)

_NO_VIEWS = (
    "the loaded map has no views of its keyframes: the point map and the mesh of this run lack its part;"
    " `run --save-map` saves views"
)


class Run:
    """A run of one sequence, which writes all its files. The log goes to the file of `log_to`.

    Args:
        request: Configuration and outputs of the run. Its inputs are not opened; they are the next arguments.
        sequence: Frames.
        segment: Segmenter.
        folder: Folder of the results; it exists.
        viewer: Viewer that shows each frame; None for no viewer.
        known_map: Map of an earlier run in which the camera is localised; None to start a new map.
        checkpoint: Checkpoint of the same run to resume from; None to start with the first frame.
        save_checkpoints: False to save no checkpoints.

    Attributes:
        pipeline: Pipeline of the run.

    Raises:
        OutputError: If the folder cannot be written.
    """

    def __init__(
        self,
        request: RunRequest,
        sequence: RGBDStream,
        segment: Segmenter,
        folder: Path,
        *,
        viewer: Viewer | None = None,
        known_map: StoredMap | None = None,
        checkpoint: Checkpoint | None = None,
        save_checkpoints: bool = True,
    ) -> None:
        config = request.config
        write_text(folder / RunFile.CONFIG, dump_config(config))  # fails before the first frame if the disk is full
        write_request(folder, request)
        slam = make_system(sequence.camera, segment, config, None if known_map is None else known_map.map)
        self._folder = folder
        self._request = request
        self._is_resumed = checkpoint is not None
        self._map_file = None if request.save_map is None else Path(request.save_map)
        self.pipeline = Pipeline(
            sequence,
            slam,
            folder / MASKS if request.save_masks else None,
            viewer,
            None if known_map is None else known_map.views,
            map_masks=folder / MAP_MASKS if request.save_masks else None,
            skip_broken=request.skip_broken,
        )
        if checkpoint is not None:
            remove_unfinished(folder)
            (folder / RunFile.REPORT).unlink(missing_ok=True)  # it shows the part before the interruption
            self.pipeline.load_state_dict(checkpoint.state)
            _LOG.info("resumed after %d frames", checkpoint.frames)
            for warning in self.pipeline.record.warnings:
                _LOG.warning(warning)  # also on the screen, where only the earlier process has shown it
        if known_map is not None and len(known_map.views) == 0:
            self.pipeline.warn([_NO_VIEWS])
        self._autosave = Autosave(folder, self.pipeline, request if save_checkpoints else None)

    def __call__(self, on_frame: FrameCallback) -> Evaluation | None:
        """Process all frames and write the results.

        Args:
            on_frame: Called after each frame; a KeyboardInterrupt that it raises ends the run between two frames.

        Returns:
            The scores, if there is ground truth. If the run ended early, or the map file cannot be written,
            ``pipeline.record.failure`` is the reason, and the last checkpoint stays. If the results of a whole run are
            incomplete, ``pipeline.record.diagnosis`` is the cause.

        Raises:
            OutputError: If the results cannot be written; the message also has the other failures of the run. A
                checkpoint is saved, if it can be written; if the run ended early, its last checkpoint stays.
        """
        sequence = self.pipeline.sequence
        _LOG.info("%s: %s frames", sequence.name, len(sequence) if isinstance(sequence, Sized) else "live")
        stored = stored_source(sequence)
        if isinstance(stored, ImageSequence):
            self.pipeline.warn(stored.notes)

        def log_and_save(frame: RGBDFrame, result: FrameResult) -> None:
            motion = describe_motion(result) or "nothing moves"
            _LOG.info("frame %d at %.6f: %s; %s", frame.index, frame.stamp, result.status.value, motion)
            self._autosave()
            on_frame(frame, result)

        record = self.pipeline(log_and_save)
        is_whole = record.failure is None  # also if a viewer cannot write its file afterwards
        self._autosave.end()
        from v3d_torch.runs.results import prepare_intermediate_results, write_results  # slow, needed only now

        try:
            self.pipeline.flush()
            slam = self.pipeline.slam
            _LOG.info("readout: %s", describe_readout(slam.map.readout, slam.config.rolling_shutter))
            if self._map_file is not None:
                self._save_map(self._map_file, is_whole=is_whole)
            self._restore_folder()
            evaluation = write_results(self._folder, self.pipeline, self._request)
        except OutputError as error:  # the run is resumed when there is space again
            record.add_failure(str(error))
            with suppress(OutputError):
                prepare_intermediate_results(self._folder, self.pipeline)()
            if is_whole:  # else the checkpoint from before `flush` stays, which would change the next frames
                self._autosave.end()
            raise OutputError(record.failure) from error
        self._autosave.discard()
        if problem := record.failure or record.diagnosis:
            _LOG.error(problem)
        return evaluation

    def _restore_folder(self) -> None:
        """Write the request again if the folder was removed during the run, and warn of what is lost."""
        if not (self._folder / RunFile.REQUEST).is_file():
            write_request(self._folder, self._request)
            self.pipeline.warn(
                [f"{self._folder}: was removed during the run; what was written before is lost, such as log and masks"]
            )

    def _save_map(self, path: Path, *, is_whole: bool) -> None:
        """Write the map file; a part of a map is written beside a map file that exists, and does not replace it."""
        pipeline, target = self.pipeline, path
        beside = path.with_name(f"{path.stem}.partial{path.suffix}")
        if not pipeline.slam.map.active_keyframes:
            pipeline.warn([f"{path}: was not written, because the map of this run has no keyframes"])
            return
        if path.exists() and not is_whole:
            target = beside
            pipeline.warn([f"{path}: was not overwritten, because the run ended early; its map is saved to {target}"])
        try:
            check_map_path(target, self._folder)  # again: a file can have been put there during the run
            save_map(target, pipeline.slam.map, pipeline.views)
            if is_whole and self._is_resumed and is_map_file(beside):
                beside.unlink(missing_ok=True)  # the map of the same run when it ended early
        except OutputError as error:  # the other results are written nevertheless
            if is_whole:
                pipeline.record.add_failure(str(error))
                self._autosave.end()  # a short run has no checkpoint yet, from which the map can be saved again
            else:
                pipeline.warn([str(error)])


def describe_readout(readout: Readout, expected: RollingShutterConfig) -> str:
    """Return the readout in words, and whether the images determine it."""
    if not expected.enabled:
        return "not compensated"
    if readout.is_certain:
        return f"{readout.seconds:.4f} s, as the camera states"
    if readout.sigma > expected.readout_sigma / 2:
        uncertainty = f"the images determine it only with a standard deviation of {readout.sigma:.4f} s"
        return f"{readout.seconds:.4f} s; {uncertainty}"
    return f"{readout.seconds:.4f} s, standard deviation {readout.sigma:.4f} s"


def describe_motion(objects: FrameObjects) -> str:
    """Return a text with the objects that are not static, by class and motion state; empty if there are none."""
    counts = Counter(
        f"{class_name(each.label)} {each.motion_state.value}"
        for each in objects.objects
        if each.motion_state is not MotionState.STATIC
    )
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
