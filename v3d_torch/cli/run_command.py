"""Steps of the run command: open the inputs, run, print the summary."""

from __future__ import annotations

import os
import shlex
from collections import Counter
from collections.abc import Mapping, Sized
from dataclasses import dataclass, field, replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from v3d_torch.batch.batch_folder import describe_contents
from v3d_torch.config import Config
from v3d_torch.config.loading import FULL, find_config, load_config, override_config
from v3d_torch.datasets import RGBDSequence, RGBDStream
from v3d_torch.datasets.realtime_playback import RealtimePlayback
from v3d_torch.datasets.tum_extents import describe_difference
from v3d_torch.errors import ConfigError, InputError, LockedError, OutputError
from v3d_torch.evaluation import Evaluation
from v3d_torch.evaluation.evaluation import format_coverage, note_too_few_poses
from v3d_torch.evaluation.outcome import label_sequence
from v3d_torch.evaluation.paper_tables import make_paper_table
from v3d_torch.io.files import check_writable
from v3d_torch.mapping.map_io import load_map
from v3d_torch.pipeline import Pipeline, Viewer, ViewerGroup
from v3d_torch.runs.checkpoint import Checkpoint, describe_change, is_finished, read_checkpoint
from v3d_torch.runs.console import run_with_progress
from v3d_torch.runs.file_names import MAP_MASKS, MASKS, RunFile
from v3d_torch.runs.map_file import check_map_path
from v3d_torch.runs.open_sequences import print_notes
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.profile_table import profile_table
from v3d_torch.runs.progress_bar import ProgressBar, progress_bars
from v3d_torch.runs.request import CHANGEABLE, RunRequest, check_not_moved
from v3d_torch.runs.result_folder import check_unlocked, find_earlier_results, make_result_folder, remove_empty_folder
from v3d_torch.runs.run import Run
from v3d_torch.runs.segmentation_files import SegmentationFiles
from v3d_torch.runs.system import check_map_is_given
from v3d_torch.runtime.stage_import import first_not_given
from v3d_torch.segmentation import MaskFolder, make_segmenter
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
    if is_finished(folder):
        print_line(Console(soft_wrap=True), f"{folder}: the run is finished; nothing to resume")
        return
    checkpoint = read_checkpoint(folder)
    request = checkpoint.request
    if out is not None and out.resolve() != folder.resolve():
        raise InputError(f"--out {out}: conflicts with the run in {folder}; remove this option")
    if (option := request.conflicting_option(given)) is not None:
        raise InputError(f"{option}: conflicts with the run in {folder}; remove this option")
    if (option := choice.conflict(request.config)) is not None:
        raise ConfigError(f"{option}: conflicts with the run in {folder}; remove this option")
    if (stage := first_not_given(request.config.stages, choice.load().stages)) is not None:
        raise ConfigError(
            f"{folder}: its run imported code, {stage}; give --set {stage} again if it is to be imported, too"
        )
    changed = {name: value for name in CHANGEABLE if (value := getattr(given, name))}
    _run(replace(request, **changed), folder, checkpoint, display)


def _run(request: RunRequest, out: Path | None, checkpoint: Checkpoint | None, display: Display) -> None:
    """Open the inputs, run and print the summary."""
    console = Console(soft_wrap=True)
    if request.save_map is not None:
        _check_map_path(Path(request.save_map), out, display)
    masks = _path(request.masks)
    replaces_results = False
    if out is not None:  # checked before the inputs are opened, and before a recording is created, which would remain
        check_unlocked(out)
        replaces_results = _check_contents(out, masks, is_resumed=checkpoint is not None)
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
    segment = make_segmenter(request.config, sequence.camera, weights=_path(request.weights), masks_dir=masks)
    if isinstance(segment, MaskFolder) and checkpoint is None:
        if isinstance(sequence, Sized):
            segment.check_number(len(sequence))
        if isinstance(sequence, RGBDSequence) and not request.skip_broken:  # a broken frame needs no id image
            segment.check_stamps(sequence.stamps)
    if checkpoint is not None:
        _check_segmentation(checkpoint, SegmentationFiles(request.weights, segment, sequence))
    viewer = display.make_viewer(sequence)
    is_new = out is None or not out.exists()
    folder = make_result_folder(out, sequence.name)
    if replaces_results:
        print_line(console, f"note: {folder}: the results of an earlier run are replaced")
    if checkpoint is not None:
        total = len(sequence) if isinstance(sequence, Sized) else checkpoint.frames
        print_line(console, f"resuming after {checkpoint.frames} of {total} frames")
    try:
        pipeline, evaluation = run_with_progress(
            lambda: Run(request, sequence, segment, folder, viewer=viewer, known_map=known_map, checkpoint=checkpoint),
            sequence,
            folder,
            console,
            checkpoint,
        )
    except LockedError:  # the checkpoint in the folder is that of the other run
        raise
    except OutputError as error:
        raise OutputError(f"{error}{_way_to_resume(folder, sequence)}") from error
    except KeyboardInterrupt as interrupt:  # the first Ctrl-C ends the run after the current frame
        if is_new:
            remove_empty_folder(folder)
        raise InputError(
            f"{folder}: interrupted before the results were written{_way_to_resume(folder, sequence)}"
        ) from interrupt
    _print_summary(request, display, folder, pipeline, evaluation, console)


def _check_segmentation(checkpoint: Checkpoint, files: SegmentationFiles) -> None:
    """Check that the weights, or the id images of the processed frames, are those of the run.

    Raises:
        InputError: If a file has changed.
    """
    if checkpoint.segmentation and (changed := files.changed_file(checkpoint.segmentation)) is not None:
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


def _print_summary(
    request: RunRequest,
    display: Display,
    folder: Path,
    pipeline: Pipeline,
    evaluation: Evaluation | None,
    console: Console,
) -> None:
    """Print the result of a run.

    Raises:
        InputError: If the run ended early, or its results are incomplete.
    """
    record = pipeline.record
    difference = describe_difference(pipeline.sequence)
    console.print(_summary_table(request, pipeline, evaluation, difference))
    if record.failure is not None and len(pipeline.slam.poses) + len(record.broken) < pipeline.frame_count:
        difference = difference or f"part: {len(pipeline.slam.poses)} of {pipeline.frame_count} frames"
    paper = None if evaluation is None else make_paper_table(pipeline.sequence.name, evaluation, difference)
    if paper is not None:
        console.print(paper)
    if display.profile and record.times:
        console.print(profile_table(record))
    absent = note_too_few_poses(pipeline.sequence.groundtruth, len(pipeline.slam.poses))
    for note in absent if evaluation is None else evaluation.notes:
        print_line(console, f"note: {note}")
    if record.save_error is not None:
        print_line(console, f"note: no checkpoint was saved, {record.save_error}")
    print_line(console, f"results: {folder}")
    if record.failure is not None:
        frames, fix = len(pipeline.slam.poses), _way_to_resume(folder, pipeline.sequence)
        results = f"the results of the {frames} frames before are in {folder}{fix}"
        raise InputError(f"{record.failure} ({results})")
    if record.diagnosis is not None:
        raise InputError(f"{record.diagnosis} (the results are in {folder})")


def _way_to_resume(folder: Path, sequence: RGBDStream) -> str:
    """Return the end of a message on a run that ended early: how to resume it.

    It is empty if the run has no checkpoint, or that of a live stream, which contains no state.
    """
    can_resume = isinstance(sequence, RGBDSequence) and (folder / RunFile.CHECKPOINT).is_file()
    return f"; resume with --resume {shlex.quote(str(folder))}" if can_resume else ""


def _summary_table(
    request: RunRequest, pipeline: Pipeline, evaluation: Evaluation | None, difference: str | None
) -> Table:
    slam, record = pipeline.slam, pipeline.record
    statuses = Counter(slam.poses.statuses)
    motion_states = record.dynamics.count_motion_states()
    label = label_sequence(pipeline.sequence.name, difference)
    table = Table(title=f"V3D-SLAM on {escape(label)}", show_header=False)
    broken = f", {len(record.broken)} broken and skipped" if record.broken else ""
    table.add_row("frames", f"{len(slam.poses)} of {pipeline.frame_count}{broken}")
    table.add_row("poses", ", ".join(f"{count} {status.value}" for status, count in statuses.items()))
    active = slam.map.active_keyframes
    known = sum(keyframe.is_from_earlier_run for keyframe in active)
    table.add_row("keyframes, loops", f"{len(active) - known}, {slam.loop_closer.loop_count}")
    if request.load_map is not None:
        table.add_row("loaded map", f"{known} {'keyframe' if known == 1 else 'keyframes'} left")
    table.add_row("objects", str(record.dynamics.count_objects()))
    if motion_states:
        table.add_row("frames of objects", ", ".join(f"{count} {state}" for state, count in motion_states.items()))
    for title, name in (("latency of poses", "pose_latency"), ("latency of results", "latency")):
        if (latency := record.live.statistics(name)) is not None:
            table.add_row(title, f"median {1e3 * latency['median']:.0f} ms, 95% below {1e3 * latency['p95']:.0f} ms")
    if len(record.live):
        rejected = f", {record.rejected} late or out of order" if record.rejected else ""
        table.add_row("dropped", f"{record.live.dropped} of {pipeline.frame_count} frames{rejected}")
    table.add_row("frames per second", f"{len(slam.poses) / record.seconds:.1f}" if record.seconds else "-")
    if evaluation is not None:
        coverage = "" if evaluation.coverage is None else f" (coverage {format_coverage(evaluation.coverage)})"
        table.add_row("ATE rmse", f"{evaluation.ate.rmse:.4f} m{coverage}")
        if evaluation.pairs < evaluation.poses:
            table.add_row("scored", evaluation.pairs_text)
        if evaluation.rpe is not None:
            table.add_row("RPE rmse", f"{evaluation.rpe.trans.rmse:.4f} m/s, {evaluation.rpe.rot.rmse:.3f} deg/s")
    if (masks := record.mask_evaluation.compute_scores()) is not None:
        fractions = {"moving": masks.moving_masked, "static": masks.static_masked}
        texts = [f"{value:.1%} of the {name} pixels" for name, value in fractions.items() if value is not None]
        table.add_row("masked", ", ".join(texts))
        if (id_switches := masks.id_switches_per_60_frames) is not None:
            table.add_row("id switches", f"{id_switches:.1f} per 60 frames ({masks.people_found:.0%} found)")
    return table
