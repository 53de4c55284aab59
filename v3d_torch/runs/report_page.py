"""HTML report of a run: errors, plots, pictures and configuration in one self-contained page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
import torch
from numpy.typing import NDArray

from v3d_torch.config import Config, Section
from v3d_torch.errors import InputError
from v3d_torch.evaluation.evaluation import note_too_few_poses
from v3d_torch.io.image_file import read_image
from v3d_torch.io.timestamps import format_timestamp
from v3d_torch.runs.file_names import MASKS, RunFile
from v3d_torch.runs.stored_run import StoredRun
from v3d_torch.runs.wall_time import describe_wall_time
from v3d_torch.viz.figure_output import embed_image, embed_svg
from v3d_torch.viz.object_timelines import ObjectRow, draw_object_timelines
from v3d_torch.viz.pose_timelines import draw_errors, draw_masked_fraction, draw_positions, draw_statuses
from v3d_torch.viz.stage_times import draw_stage_bars, draw_stages_over_time
from v3d_torch.viz.trajectory_figure import draw_trajectory

_FIGURES = {
    RunFile.MASKS_FIGURE: "Frames with the mask of each object in the colour of its motion state.",
    RunFile.VOTING_FIGURE: "Frame with the most votes for dynamic objects: a line connects two objects, one of which"
    " voted for the other over some time span. The number of an object is that of the time span with the most votes,"
    " plus one if the free-space check agrees.",
    RunFile.CLUSTERS_FIGURE: "Point clouds of the objects in the frame with the most votes for dynamic objects, or with"
    " the most objects if there are no votes, before and after outlier rejection.",
    RunFile.OBJECTS_FIGURE: "The room from above: path and last box of the objects in the colour of their motion state,"
    " with an arrow to where a dynamic object would be a second later.",
    RunFile.OCCUPANCY_FIGURE: "Occupancy map from above: the distance to obstacles and, if the floor is visible, its"
    " free and occupied parts.",
}
"""Caption of each picture of a run."""


@dataclass(frozen=True)
class StageSummary:
    """Time of a stage per frame, seconds; ``median`` and ``max`` are None if the times of frames were not stored."""

    name: str
    total: float
    mean: float
    median: float | None
    max: float | None


def render_page(run: StoredRun) -> str:
    """Return the report of a run as HTML.

    Args:
        run: Results of the run.

    Raises:
        InputError: If a picture in its folder is damaged.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    stages = _stage_times(run)
    return environment.get_template("report_page.html").render(
        metrics=run.metrics,
        folder=run.folder.resolve().name,  # resolved, because "latest" changes and "." is not a name
        evaluation=run.evaluation,
        absent_notes=note_too_few_poses(run.groundtruth, len(run.metrics.status)),
        pose_plots=_pose_plots(run),
        tracking_plots=_tracking_plots(run),
        objects=_object_plot(run),
        masked=_masked_percentages(run.metrics.masks or {}),
        pictures=[
            (embed_image(run.folder / name), caption)
            for name, caption in _FIGURES.items()
            if (run.folder / name).is_file()
        ],
        stages=stages,
        describe_wall_time=describe_wall_time,
        stage_plots=_stage_plots(run, stages),
        changes=changed_values(run.config) if run.config is not None else None,
        config_text=run.config_text,
    )


def changed_values(config: Config) -> list[tuple[str, Any, Any]]:
    """Return the values that differ from the defaults: key, value, default."""
    return _differences(config, Config(), "")


def _differences(section: Section, default: Section, prefix: str) -> list[tuple[str, Any, Any]]:
    differences: list[tuple[str, Any, Any]] = []
    for name in type(section).model_fields:
        value, default_value = getattr(section, name), getattr(default, name)
        if isinstance(value, Section):
            differences += _differences(value, default_value, f"{prefix}{name}.")
        elif value != default_value:
            differences.append((f"{prefix}{name}", value, default_value))
    return differences


def _masked_percentages(scores: Mapping[str, Any]) -> list[str]:
    """Return the masked percentages of the moving and static pixels as text, without those that were not measured."""
    fractions = {name: scores.get(f"{name}_masked") for name in ("moving", "static")}
    return [f"{100 * fraction:.1f} % of the {name}" for name, fraction in fractions.items() if fraction is not None]


def _pose_plots(run: StoredRun) -> dict[str, str]:
    estimate, truth, evaluation = run.trajectory, run.groundtruth, run.evaluation
    if estimate is None:
        return {}
    plots = {
        "trajectory": embed_svg(
            draw_trajectory(truth if evaluation else None, estimate, statuses=run.metrics.status), "trajectory"
        ),
        "positions": embed_svg(draw_positions(truth, estimate, evaluation), "positions"),
    }
    if truth is not None and evaluation is not None:
        plots["errors"] = embed_svg(draw_errors(truth, estimate, evaluation, run.metrics.status), "errors")
    return plots


def _tracking_plots(run: StoredRun) -> dict[str, str]:
    """Draw the tracking status and, if masks were saved, the masked fraction of the image."""
    if run.trajectory is None:
        return {}
    keyframes = run.keyframes.stamps if run.keyframes is not None else torch.zeros(0, dtype=torch.float64)
    plots = {"statuses": embed_svg(draw_statuses(run.trajectory.stamps, run.metrics.status, keyframes), "statuses")}
    folder = run.folder / MASKS
    masks = [(stamp, folder / f"{format_timestamp(stamp)}.png") for stamp in run.trajectory.stamps.tolist()]
    saved = [(stamp, path) for stamp, path in masks if path.is_file()]
    if saved:
        fractions = torch.tensor([_masked_fraction(path) for _, path in saved], dtype=torch.float64)
        stamps = torch.tensor([stamp for stamp, _ in saved], dtype=torch.float64)
        plots["masked"] = embed_svg(draw_masked_fraction(stamps, fractions), "masked")
    return plots


def _masked_fraction(path: Path) -> float:
    mask = read_image(path, cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise InputError(f"{path}: is truncated or not an image; delete it, or run the sequence again")
    return float((mask > 0).mean())


def _object_plot(run: StoredRun) -> dict[str, Any] | None:
    """Draw the objects over time; None without a table of objects, and no plot if the table is empty."""
    if run.objects is None:
        return None
    table = [
        ObjectRow(
            stamp=row["stamp"],
            id=row["id"],
            name=row["class"],
            motion_state=row["motion_state"],
            votes=row["votes"],
            chamfer=row["chamfer"] if row["chamfer"] is not None else math.nan,
        )
        for row in run.objects.to_pylist()
    ]
    if not table:
        return {"count": 0}
    frames = run.frames.column("stamp").to_pylist() if run.frames is not None else []
    stamps = sorted({*frames, *(row.stamp for row in table)})
    threshold = run.config.objects.chamfer.distance_threshold if run.config is not None else None
    figure, omitted = draw_object_timelines(stamps, table, threshold)
    return {"count": len({row.id for row in table}), "omitted": omitted, "plot": embed_svg(figure, "objects")}


def _stage_times(run: StoredRun) -> list[StageSummary]:
    frames = max(run.metrics.processed, 1)
    per_frame = _seconds_per_frame(run)
    return [
        StageSummary(
            name=name,
            total=total,
            mean=total / frames,
            median=float(np.median(per_frame[name])) if name in per_frame else None,
            max=float(per_frame[name].max()) if name in per_frame else None,
        )
        for name, total in run.metrics.seconds_per_stage.items()
    ]


def _stage_plots(run: StoredRun, stages: list[StageSummary]) -> list[str]:
    plots = [embed_svg(draw_stage_bars({stage.name: stage.mean for stage in stages}), "stages")] if stages else []
    if run.frames is not None and (per_frame := _seconds_per_frame(run)):
        stamps = run.frames.column("stamp").to_pylist()
        plots.append(embed_svg(draw_stages_over_time(stamps, per_frame), "stages_over_time"))
    return plots


def _seconds_per_frame(run: StoredRun) -> dict[str, NDArray[np.float64]]:
    """Return the time of each stage in each frame, seconds, shape (frames,); empty if not stored."""
    table = run.frames
    if table is None or not len(table):
        return {}
    prefix = "seconds_"
    names = [name for name in table.column_names if name.startswith(prefix)]
    return {name.removeprefix(prefix): table.column(name).to_numpy() for name in names}
