"""Steps of the run command: open the inputs, run, print the summary."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sized
from dataclasses import dataclass, field, replace
from pathlib import Path

from rich.console import Console

from v3d_torch.batch.batch_folder import describe_contents
from v3d_torch.config import Config
from v3d_torch.config.loading import FULL, find_config, load_config, override_config
from v3d_torch.datasets import RGBDSequence, RGBDStream
from v3d_torch.datasets.realtime_playback import RealtimePlayback, stored_source
from v3d_torch.errors import ConfigError, InputError, LockedError, OutputError, RunError
from v3d_torch.io.files import check_writable
from v3d_torch.mapping.map_io import StoredMap, load_map
from v3d_torch.pipeline import Viewer, ViewerGroup
from v3d_torch.runs.checkpoint import Checkpoint, describe_change, is_finished, read_checkpoint
from v3d_torch.runs.console import run_with_progress
from v3d_torch.runs.file_names import MAP_MASKS, MASKS, RunFile
from v3d_torch.runs.map_file import check_map_path
from v3d_torch.runs.open_sequences import print_notes
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.progress_bar import ProgressBar, progress_bars
from v3d_torch.runs.request import CHANGEABLE, RunRequest, check_not_moved, read_request
from v3d_torch.runs.result_folder import check_unlocked, find_earlier_results, make_result_folder, remove_empty_folder
from v3d_torch.runs.run import Run
from v3d_torch.runs.run_summary import check_complete, print_summary, way_to_resume
from v3d_torch.runs.segmentation_files import SegmentationFiles
from v3d_torch.runs.system import check_map_is_given
from v3d_torch.runtime.stage_import import first_not_given
from v3d_torch.segmentation import MaskFolder, make_segmenter
from v3d_torch.types import Segmenter
from v3d_torch.viz.viewer import make_viewer


@dataclass(frozen=True)
class ConfigChoice:
    """Configuration as given on the command line.

    Attributes:
        name: Name or file of a configuration; None for the default.
        overrides: Values to set, such as ``objects.voting.distance_threshold=0.05``.
        options: Values to set by the options that stand for them, as they are typed: ``seed=3`` by ``--seed 3``.
    """

    name: str | None
    overrides: tuple[str, ...]
    options: Mapping[str, str] = field(default_factory=dict)

    def load(self) -> Config:
        """Load the configuration.

        Raises:
            ConfigError: If the name, a key or a value is not valid, or if an option and an override set the same key to
                different values.
        """
        config = load_config(find_config(FULL if self.name is None else self.name), self.overrides)
        for option, override in self.options.items():
            changed = override_config(config, [override], source=option)
            if changed != config:
                for other in self.overrides:
                    if _key(other) == _key(override):
                        raise ConfigError(f"{option}: conflicts with --set {other}; remove one of them")
            config = changed
        return config

    def conflict(self, config: Config) -> str | None:
        """Return the first option that would change a configuration, as it is typed; None if there is none."""
        if self.name is not None and self.load() != config:
            return f"--config {self.name}"
        given = {**{f"--set {override}": override for override in self.overrides}, **self.options}
        return next(
            (option for option, override in given.items() if override_config(config, [override]) != config), None
        )


def _key(override: str) -> str:
    """Return the key that an override sets."""
    return override.partition("=")[0].strip()


@dataclass(frozen=True)
class Display:
    """Output of a run in addition to its files and its summary.

    Attributes:
        viz: Viewer that shows the run live, ``rerun``; None for no viewer.
        rerun_file: New file in which the run is recorded for rerun; None for no recording.
        bag: New file in which the run is recorded as ROS 2 messages; None for no recording.
        profile: True to print the time of each stage.
    """

    viz: str | None = None
    rerun_file: Path | None = None
    bag: Path | None = None
    profile: bool = False

    def make_viewer(self, sequence: RGBDStream) -> Viewer:
        """Create the viewer of a run.

        Raises:
            ConfigError: If the viewer is unknown.
            ViewerError: If the viewer cannot be started.
            OutputError: If a recording exists or cannot be written.
        """
        viewers: list[Viewer] = []
        if self.bag is not None:
            from v3d_torch.export.ros.bag_viewer import BagViewer  # slow: loads the definitions of all messages

            viewers.append(BagViewer(self.bag, sequence.camera))
        viewer = make_viewer(self.viz, self.rerun_file, sequence)  # last, because it creates its file
        return ViewerGroup(viewers if viewer is None else [*viewers, viewer])


def start_run(request: RunRequest, out: Path | None, display: Display) -> None:
    """Run a sequence from its first frame.

    Args:
        request: Inputs, outputs and configuration.
        out: Folder of the results; None to make a new one.
        display: Output on the screen.

    Raises:
        V3DError: If an input is not valid, or the run ended early; its results so far are written.
    """
    check_map_is_given(request.config, request.load_map)
    _run(request, out, None, display)


def resume_run(folder: Path, given: RunRequest, choice: ConfigChoice, out: Path | None, display: Display) -> None:
    """Resume a run that was killed or interrupted.

    Args:
        folder: Folder of its results.
        given: Options given with ``--resume``. Only options in `CHANGEABLE` can differ from those of the run.
        choice: Configuration given with ``--resume``.
        out: Folder given with ``--out``: the same as ``folder``, or None.
        display: Output on the screen.

    Raises:
        V3DError: If there is no checkpoint, if the run was live, if an option conflicts with it, or as for `start_run`.
    """
    checkpoint = None if is_finished(folder) else read_checkpoint(folder)
    request = _request_of_finished_run(folder) if checkpoint is None else checkpoint.request
    if out is not None and out.resolve() != folder.resolve():
        raise InputError(f"--out {out}: conflicts with the run in {folder}; remove this option")
    if (option := request.conflicting_option(given)) is not None:
        raise InputError(f"{option}: conflicts with the run in {folder}; remove this option")
    if (option := choice.conflict(request.config)) is not None:
        raise ConfigError(f"{option}: conflicts with the run in {folder}; remove this option")
    if checkpoint is None:
        print_line(Console(soft_wrap=True), f"{folder}: the run is finished; nothing to resume")
        return
    if (stage := first_not_given(request.config.stages, choice.load().stages)) is not None:
        raise ConfigError(
            f"{folder}: its run imported code, {stage}; give --set {stage} again if it is to be imported, too"
        )
    changed = {name: value for name in CHANGEABLE if (value := getattr(given, name))}
    _run(replace(request, **changed), folder, checkpoint, display)


def _request_of_finished_run(folder: Path) -> RunRequest:
    """Read the options and the configuration with which a run was started.

    Raises:
        InputError: If the file of its options is missing or damaged.
        ConfigError: If that of its configuration is.
    """
    return replace(read_request(folder), config=load_config(folder / RunFile.CONFIG))


@dataclass(frozen=True)
class _Inputs:
    """Opened inputs of a run: frames, source of instances, and the map in which the camera is localised, if any."""

    sequence: RGBDStream
    segment: Segmenter
    known_map: StoredMap | None


def _run(request: RunRequest, out: Path | None, checkpoint: Checkpoint | None, display: Display) -> None:
    """Open the inputs, run and print the summary."""
    console = Console(soft_wrap=True)
    # Checked before the inputs are opened, and before a recording is created, which would remain.
    replaces_results = _check_outputs(request, out, display, is_resumed=checkpoint is not None)
    inputs = _open_inputs(request, checkpoint, console)
    viewer = display.make_viewer(inputs.sequence)
    is_new = out is None or not out.exists()
    folder = make_result_folder(out, inputs.sequence.name)
    if replaces_results:
        print_line(console, f"note: {folder}: the results of an earlier run are replaced")
    if checkpoint is not None:
        total = len(inputs.sequence) if isinstance(inputs.sequence, Sized) else checkpoint.frames
        print_line(console, f"resuming after {checkpoint.frames} of {total} frames")
    try:
        pipeline, evaluation = run_with_progress(
            lambda: Run(request, **vars(inputs), folder=folder, viewer=viewer, checkpoint=checkpoint),
            inputs.sequence,
            folder,
            console,
            checkpoint,
        )
    except LockedError:  # the checkpoint in the folder is that of the other run
        raise
    except OutputError as error:
        raise OutputError(f"{error}{way_to_resume(folder, inputs.sequence)}") from error
    except KeyboardInterrupt as interrupt:  # the first Ctrl-C ends the run after the current frame
        if is_new:
            remove_empty_folder(folder)
        raise RunError(
            f"{folder}: interrupted before the results were written{way_to_resume(folder, inputs.sequence)}"
        ) from interrupt
    print_summary(request, folder, pipeline, evaluation, console, profile=display.profile)
    check_complete(folder, pipeline)


def _check_outputs(request: RunRequest, out: Path | None, display: Display, *, is_resumed: bool) -> bool:
    """Check that the files of a run can be written, and that they replace no files but those of an earlier run.

    Returns:
        True if a new run replaces the results of an earlier one.

    Raises:
        OutputError: If they cannot, or if another run writes to the folder.
    """
    if request.save_map is not None:
        _check_map_path(Path(request.save_map), out, display)
    if out is None:
        return False
    source = Path(request.absolute().seq)  # relative if it is the name of a sequence
    if source.is_absolute() and os.path.realpath(out) == os.path.realpath(source):
        raise OutputError(f"{out}: is the folder of the sequence; choose another folder with --out")
    check_unlocked(out)
    return _check_contents(out, _path(request.masks), is_resumed=is_resumed)


def _open_inputs(request: RunRequest, checkpoint: Checkpoint | None, console: Console) -> _Inputs:
    """Open the inputs of a run, and check that those of a resumed run have not changed.

    Raises:
        InputError: If an input is not valid or has changed.
    """
    if checkpoint is not None:
        check_not_moved(request, checkpoint.folder)
    sequence = _open_sequence(request, console)
    print_notes(sequence, console)
    if checkpoint is not None and (change := describe_change(checkpoint, sequence)) is not None:
        raise InputError(
            f"{request.seq}: has changed since the run in {checkpoint.folder} began ({change}); restore the sequence,"
            " or start a new run"
        )
    known_map = None
    if request.load_map is not None and checkpoint is None:  # a checkpoint contains the map
        known_map = load_map(Path(request.load_map), sequence.camera, request.config)
        if not known_map.map.active_keyframes:
            raise InputError(f"{request.load_map}: has no keyframes; give the map of a run that found the camera")
    weights, masks = _path(request.weights), _path(request.masks)
    segment = make_segmenter(request.config, sequence.camera, weights=weights, masks_dir=masks)
    if checkpoint is not None:
        _check_segmentation(checkpoint, SegmentationFiles(request.weights, segment, sequence))
    elif isinstance(segment, MaskFolder):
        stored = stored_source(sequence)
        if isinstance(stored, Sized):
            segment.check_number(len(stored))
        if isinstance(stored, RGBDSequence) and not request.skip_broken:  # a broken frame needs no id image
            segment.check_stamps(stored.stamps)
    return _Inputs(sequence, segment, known_map)


def _check_segmentation(checkpoint: Checkpoint, files: SegmentationFiles) -> None:
    """Check that the weights, or the id images of the processed frames, are those of the run.

    Raises:
        InputError: If a file has changed.
    """
    if (changed := files.changed_file(checkpoint.segmentation)) is not None:
        raise InputError(
            f"{changed}: has changed since the run in {checkpoint.folder} began; restore it, or start a new run"
        )


def _check_map_path(path: Path, out: Path | None, display: Display) -> None:
    """Check that a map can be saved to a path, see `check_map_path`.

    Raises:
        OutputError: If it cannot, or if a recording of the run goes to the same file.
    """
    for option, recording in (("--bag", display.bag), ("--rerun", display.rerun_file)):
        if recording is not None and os.path.realpath(recording) == os.path.realpath(path):
            raise OutputError(f"--save-map {path}: is also the file of {option}; choose another file for one of them")
    check_map_path(path, out)
    check_writable(path)


def _check_contents(folder: Path, masks: Path | None, *, is_resumed: bool) -> bool:
    """Check that a run would overwrite neither the masks that it reads, files of the user, nor an interrupted run.

    Returns:
        True if a new run replaces the results of an earlier one.

    Raises:
        OutputError: If it would, or if a new run would mix its results with those of a batch or an ablation study.
    """
    written = [os.path.realpath(folder / name) for name in (MASKS, MAP_MASKS)]  # also of a loop of links
    if masks is not None and os.path.realpath(masks) in written:
        raise OutputError(f"{masks}: would be written while it is read; choose another folder with --out")
    if is_resumed:
        return False
    if (contents := describe_contents(folder)) is not None:
        raise OutputError(f"{folder}: contains {contents}; choose another folder with --out")
    resolved = Path(os.path.realpath(folder))
    above = resolved.parents[2:3] if resolved.match("seed*") else ()  # <batch>/<sequence>/<configuration>/seed<k>
    for contents in filter(None, map(describe_contents, above)):  # its tables would have the values of another run
        raise OutputError(f"{folder}: is the folder of a run of {contents}; choose another folder with --out")
    earlier = find_earlier_results(folder)
    if folder / RunFile.CHECKPOINT in earlier:
        raise OutputError(
            f"{folder}: has an interrupted run; continue it with --resume {shlex.quote(str(folder))}, choose another"
            " folder with --out, or delete this one"
        )
    return bool(earlier)


def _open_sequence(request: RunRequest, console: Console) -> RGBDStream:
    if request.realtime and request.skip_broken:
        raise ConfigError("--realtime: a broken frame ends the playback; remove --skip-broken")
    with progress_bars(console) as progress:
        source = request.open_source(ProgressBar(progress, "sequence"))
    return RealtimePlayback(source) if request.realtime else source


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)
