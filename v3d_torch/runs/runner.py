"""One run from what was asked to its last sentence: what ``python -m v3d_torch.run`` does."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from v3d_torch.cli.console import ProgressBar, progress_bars, result_folder, track
from v3d_torch.config import Config
from v3d_torch.config.loading import FULL, changed, find_config, load_config
from v3d_torch.datasets import RGBDStream, open_source
from v3d_torch.errors import ConfigError, InputError, OutputError
from v3d_torch.evaluation import Evaluation
from v3d_torch.evaluation.tables import paper_table
from v3d_torch.io.files import check_writable
from v3d_torch.mapping.map_io import StoredMap, load_map, save_map
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.checkpoint import CHECKPOINT, Checkpoint, describe_change, is_finished, read_checkpoint
from v3d_torch.runs.diagnosis import diagnose
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.stage_table import stage_table
from v3d_torch.runs.state import empty_map
from v3d_torch.segmentation import make_segmenter
from v3d_torch.viz.viewer import make_viewer


@dataclass(frozen=True)
class Display:
    """What a run shows beside its summary.

    Attributes:
        viz: program to look on with, rerun; None for none.
        rerun_file: to record for rerun; None for none.
        profile: whether to say what each stage took.
    """

    viz: str | None = None
    rerun_file: Path | None = None
    profile: bool = False


def run_sequence(
    request: RunRequest, display: Display, *, config_name: str | None, overrides: Sequence[str], out: Path | None
) -> None:
    """Run one sequence with everything shown and written; see ``python -m v3d_torch.run --help``.

    Raises:
        V3DError: on bad input, or when the sequence ended early (the results up to there are written).
    """
    config = load_config(find_config(config_name or FULL), overrides)
    if request.load_map is None and not config.mapping.enabled:
        raise ConfigError("mapping.enabled=false: there is no map to find the camera in; give one with --load-map")
    _carry_out(request, config, out, None, display)


def resume_run(
    folder: Path,
    given: RunRequest,
    display: Display,
    *,
    config_name: str | None,
    overrides: Sequence[str],
    out: Path | None,
) -> None:
    """Go on with a run that was killed or interrupted; see ``python -m v3d_torch.run --help``.

    Args:
        folder: of its results.
        given: options beside ``--resume``: where the sequence is now, if it was moved. Others change nothing.
        display: of the frames that are left, but for the profile, which is of all.
        config_name: as the run was given it, or None.
        overrides: as the run was given them, or none.
        out: the same folder, or None.

    Raises:
        V3DError: there is nothing to go on with, an option says otherwise than the run did when it began, or as
            `run_sequence`.
    """
    console = Console(soft_wrap=True)
    if is_finished(folder):
        console.print(f"{folder}: the run came to its end already; there is nothing left to do", markup=False)
        return
    checkpoint = read_checkpoint(folder)
    stored, leave = checkpoint.request, f"than the run in {folder} began with; leave it out"
    if out is not None and out.resolve() != folder.resolve():
        raise InputError(f"--out {out}: says otherwise {leave}")
    if (option := stored.conflicting_option(given)) is not None:
        raise InputError(f"{option}: says otherwise {leave}")
    if config_name is not None and load_config(find_config(config_name), overrides) != checkpoint.config:
        raise ConfigError(f"--config {config_name}: says otherwise {leave}")
    for override in overrides:
        if changed(checkpoint.config, [override]) != checkpoint.config:
            raise ConfigError(f"{override}: says otherwise {leave}")
    moved = {name: value for name in ("seq", "data_root") if (value := getattr(given, name))}
    _carry_out(replace(stored, **moved), checkpoint.config, folder, checkpoint, display)


def _carry_out(
    request: RunRequest,
    config: Config,
    out: Path | None,
    checkpoint: Checkpoint | None,
    display: Display,
) -> None:
    console = Console(soft_wrap=True)
    map_out, masks = _path(request.save_map), _path(request.masks)
    if map_out is not None:
        check_writable(map_out)
    with progress_bars(console) as progress:
        sequence = open_source(
            request.seq,
            data_root=_path(request.data_root),
            camera=request.camera,
            options=request.options,
            progress=ProgressBar(progress, "sequence"),
        )
    if checkpoint is not None and (change := describe_change(checkpoint, sequence)) is not None:
        raise InputError(
            f"{request.seq}: is not as it was when the run in {checkpoint.folder} began, {change}; put it back, or run"
            " it again"
        )
    known = _known_map(request, sequence, config, checkpoint)
    segment = make_segmenter(config.segmentation, weights=_path(request.weights), masks_dir=masks)
    viewer = make_viewer(display.viz, display.rerun_file, sequence)
    folder = result_folder(out, sequence.name)
    if masks is not None and masks.resolve() == (folder / "masks").resolve():
        raise OutputError(f"{masks}: would be written to while it is read; choose another folder with --out")
    if checkpoint is not None:
        console.print(f"goes on after {checkpoint.frames} of {checkpoint.sequence['frames']} frames", markup=False)
    pipeline, evaluation = track(
        sequence,
        segment,
        config,
        folder,
        console,
        save_masks=request.save_masks,
        viewer=viewer,
        known=known,
        request=request,
        checkpoint=checkpoint,
    )
    if map_out is not None:
        save_map(map_out, pipeline.slam.mapper.map, pipeline.views)
    _say(request, display, folder, pipeline, evaluation, console)


def _known_map(
    request: RunRequest, sequence: RGBDStream, config: Config, checkpoint: Checkpoint | None
) -> StoredMap | None:
    """The map of an earlier run that the camera is to be found in; a checkpoint has what became of it."""
    if request.load_map is None:
        return None
    if checkpoint is None:
        return load_map(Path(request.load_map), sequence.camera, config)
    return StoredMap(empty_map(config, sequence.camera), StaticViews(sequence.camera, config.dense_map.stride))


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)


def _say(
    request: RunRequest,
    display: Display,
    folder: Path,
    pipeline: Pipeline,
    evaluation: Evaluation | None,
    console: Console,
) -> None:
    """Show how a run ended.

    Raises:
        InputError: it ended early, or lacks something.
    """
    run = pipeline.record
    console.print(_summary(pipeline, evaluation))
    if evaluation is not None and (table := paper_table(pipeline.sequence.name, evaluation)) is not None:
        console.print(table)
    if display.profile and run.frames:
        console.print(stage_table(run))
    for note in evaluation.notes if evaluation is not None else ():
        console.print(f"note: {note}", markup=False)
    if run.save_error is not None:
        console.print(f"note: while the run went on, {run.save_error}", markup=False)
    console.print(f"results: {folder}", markup=False)  # brackets in the name are no markup
    if run.failure is not None:
        done = len(pipeline.slam.poses.statuses)
        how = f"; go on with --resume {folder}" if (folder / CHECKPOINT).is_file() else ""
        raise InputError(f"{run.failure} (the results of the {done} frames before are in {folder}{how})")
    if request.load_map is not None and not pipeline.slam.poses.located:
        raise InputError(
            f"{request.load_map}: no frame of {request.seq} shows a place of this map; its results are in {folder}"
        )
    if (doubt := diagnose(pipeline, evaluation)) is not None:
        raise InputError(f"{doubt} (the results are in {folder})")


def _summary(pipeline: Pipeline, evaluation: Evaluation | None) -> Table:
    slam, run = pipeline.slam, pipeline.record
    statuses = Counter(slam.poses.statuses)
    verdicts = Counter(str(row["motion_state"]) for row in run.dynamics)
    table = Table(title=f"V3D-SLAM on {escape(pipeline.sequence.name)}", show_header=False)
    table.add_row("frames", f"{len(slam.poses.statuses)} of {pipeline.frames}")
    table.add_row("found", ", ".join(f"{count} {status.value}" for status, count in statuses.items()))
    kept = slam.mapper.map.active_keyframes
    earlier = sum(keyframe.is_from_earlier_run for keyframe in kept)
    table.add_row("keyframes, loops", f"{len(kept) - earlier}, {slam.loop_closer.loop_count}")
    if earlier:
        table.add_row("known map", f"{earlier} keyframes")
    table.add_row("objects judged", ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items()) or "none")
    table.add_row("frames a second", f"{len(slam.poses.statuses) / run.seconds:.1f}" if run.seconds else "-")
    if evaluation is not None:
        table.add_row("ATE rmse", f"{evaluation.ate.rmse:.4f} m (coverage {evaluation.coverage:.0%})")
        if evaluation.rpe is not None:
            table.add_row("RPE rmse", f"{evaluation.rpe.trans.rmse:.4f} m/s, {evaluation.rpe.rot.rmse:.3f} deg/s")
    if (masks := run.mask_evaluation.scores()) is not None:
        shares = {"moving": masks.moving_left_out, "static": masks.static_left_out}
        said = [f"{share:.1%} of the {what} pixels" for what, share in shares.items() if share is not None]
        table.add_row("left out of tracking", ", ".join(said))
        if (changes := masks.id_changes_per_60_frames) is not None:
            table.add_row("ids of people change", f"{changes:.1f} times in 60 frames ({masks.people_found:.0%} found)")
    return table
