"""Summary of a run on the screen."""

from __future__ import annotations

import shlex
from collections import Counter
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from v3d_torch.datasets import RGBDSequence, RGBDStream
from v3d_torch.datasets.tum_extents import describe_difference
from v3d_torch.errors import RunError
from v3d_torch.evaluation import Evaluation
from v3d_torch.evaluation.evaluation import format_coverage, note_too_few_poses
from v3d_torch.evaluation.outcome import label_sequence
from v3d_torch.evaluation.paper_tables import make_paper_table
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.profile_table import profile_table
from v3d_torch.runs.request import RunRequest


def print_summary(
    request: RunRequest,
    folder: Path,
    pipeline: Pipeline,
    evaluation: Evaluation | None,
    console: Console,
    *,
    profile: bool,
) -> None:
    """Print the result of a run.

    Args:
        request: Options of the run.
        folder: Folder of its results.
        pipeline: Pipeline of the run.
        evaluation: Scores; None if there are none.
        console: Console.
        profile: True to print the time of each stage.
    """
    record = pipeline.record
    difference = describe_difference(pipeline.sequence)
    console.print(_summary_table(request, pipeline, evaluation, difference))
    if record.failure is not None and len(pipeline.slam.poses) + len(record.broken) < pipeline.frame_count:
        difference = difference or f"part: {len(pipeline.slam.poses)} of {pipeline.frame_count} frames"
    paper = None if evaluation is None else make_paper_table(pipeline.sequence.name, evaluation, difference)
    if paper is not None:
        console.print(paper)
    if profile and record.times:
        console.print(profile_table(record))
    absent = note_too_few_poses(pipeline.sequence.groundtruth, len(pipeline.slam.poses))
    for note in absent if evaluation is None else evaluation.notes:
        print_line(console, f"note: {note}")
    if record.save_error is not None:
        print_line(console, f"note: no checkpoint was saved, {record.save_error}")
    print_line(console, f"results: {folder}")


def check_complete(folder: Path, pipeline: Pipeline) -> None:
    """Check that a run reached the end of its sequence with complete results.

    Raises:
        RunError: If the run ended early, or its results are incomplete.
    """
    record = pipeline.record
    if record.failure is not None:
        frames, fix = len(pipeline.slam.poses), way_to_resume(folder, pipeline.sequence)
        results = f"the results of the {frames} frames before are in {folder}{fix}"
        raise RunError(f"{record.failure} ({results})")
    if record.diagnosis is not None:
        raise RunError(f"{record.diagnosis} (the results are in {folder})")


def way_to_resume(folder: Path, sequence: RGBDStream) -> str:
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
    motion_states = record.objects.count_motion_states()
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
    table.add_row("objects", str(record.objects.count_objects()))
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
