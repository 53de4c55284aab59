"""One page that shows a run: numbers, plots, pictures, configuration; nothing in it has to be loaded."""

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
from v3d_torch.runs.stored_run import StoredRun
from v3d_torch.viz.figures import draw_trajectory
from v3d_torch.viz.inline import inline_image, inline_svg
from v3d_torch.viz.objects_over_time import ObjectRow, draw_objects_over_time
from v3d_torch.viz.stage_times import draw_stage_bars, draw_stages_over_time
from v3d_torch.viz.timelines import draw_errors, draw_positions, draw_share, draw_statuses

_FIGURES = {
    "masks.png": "Frames with each object's mask in the colour of its verdict.",
    "voting.png": "The frame with the most votes for what is dynamic: who voted for whom, and what came of it.",
    "clusters.png": "Objects of the same frame as clouds, before and after outlier rejection.",
}


@dataclass(frozen=True)
class StageTime:
    """Time of a stage, seconds; median and max are None where only the total is known."""

    name: str
    total: float
    mean: float
    median: float | None
    max: float | None


def render_page(run: StoredRun) -> str:
    """The page of a run as HTML.

    Raises:
        InputError: a picture in its folder is broken.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    stages = _stages(run)
    return environment.get_template("page.html").render(
        metrics=run.metrics,
        folder=run.folder.resolve().name,  # not "latest", which will be another, nor the empty name of "."
        evaluation=run.evaluation,
        poses=_pose_plots(run),
        found=_found_plots(run),
        objects=_object_plot(run),
        left_out=_left_out(run.metrics.masks or {}),
        pictures=[
            (inline_image(run.folder / "figures" / name), text)
            for name, text in _FIGURES.items()
            if (run.folder / "figures" / name).is_file()
        ],
        stages=stages,
        stage_plots=_stage_plots(run, stages),
        changes=changes(run.config) if run.config is not None else None,
        config_text=run.config_text,
    )


def _left_out(scores: Mapping[str, Any]) -> list[str]:
    """Shares of the truly moving and static pixels, in words; without those of which there are no pixels."""
    shares = {what: scores.get(f"{what}_left_out") for what in ("moving", "static")}
    return [f"{100 * share:.1f} % of the {what}" for what, share in shares.items() if share is not None]


def changes(config: Config) -> list[tuple[str, Any, Any]]:
    """What differs from the defaults: key, value, default."""
    return _differences(config, Config(), "")


def _differences(section: Section, default: Section, prefix: str) -> list[tuple[str, Any, Any]]:
    found: list[tuple[str, Any, Any]] = []
    for name in type(section).model_fields:
        value, usual = getattr(section, name), getattr(default, name)
        if isinstance(value, Section):
            found += _differences(value, usual, f"{prefix}{name}.")
        elif value != usual:
            found.append((f"{prefix}{name}", value, usual))
    return found


def _pose_plots(run: StoredRun) -> dict[str, str]:
    estimate, truth, evaluation = run.trajectory, run.groundtruth, run.evaluation
    if estimate is None:
        return {}
    plots = {
        "trajectory": inline_svg(draw_trajectory(truth if evaluation else None, estimate), "trajectory"),
        "positions": inline_svg(draw_positions(truth, estimate, evaluation), "positions"),
    }
    if truth is not None and evaluation is not None:
        plots["errors"] = inline_svg(draw_errors(truth, estimate, evaluation, run.metrics.status), "errors")
    return plots


def _found_plots(run: StoredRun) -> dict[str, str]:
    """How the frames were found, and how much of each image was left out, where masks were saved."""
    if run.trajectory is None:
        return {}
    none = torch.zeros(0, dtype=torch.float64)
    keyframes = run.keyframes.stamps if run.keyframes is not None else none
    plots = {"statuses": inline_svg(draw_statuses(run.trajectory.stamps, run.metrics.status, keyframes), "statuses")}
    masks = [(stamp, run.folder / "masks" / f"{stamp:.6f}.png") for stamp in run.trajectory.stamps.tolist()]
    saved = [(stamp, path) for stamp, path in masks if path.is_file()]
    if saved:
        shares = [_share(path) for _, path in saved]
        stamps = torch.tensor([stamp for stamp, _ in saved], dtype=torch.float64)
        plots["share"] = inline_svg(draw_share(stamps, torch.tensor(shares, dtype=torch.float64)), "share")
    return plots


def _share(path: Path) -> float:
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise InputError(f"{path}: is truncated or no image; delete it, or run again")
    return float((mask > 0).mean())


def _object_plot(run: StoredRun) -> dict[str, Any] | None:
    """Verdicts over time; None where no table of them is there, without a plot where it is empty."""
    if run.dynamics is None:
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
        for row in run.dynamics.to_pylist()
    ]
    if not table:
        return {"count": 0}
    frames = run.frames.column("stamp").to_pylist() if run.frames is not None else []
    stamps = sorted({*frames, *(row.stamp for row in table)})
    threshold = run.config.objects.chamfer.distance_threshold if run.config is not None else None
    figure, left_out = draw_objects_over_time(stamps, table, threshold)
    return {"count": len({row.id for row in table}), "left_out": left_out, "plot": inline_svg(figure, "objects")}


def _stages(run: StoredRun) -> list[StageTime]:
    frames = max(run.metrics.processed, 1)
    each = _seconds_per_frame(run)
    return [
        StageTime(
            name=name,
            total=total,
            mean=total / frames,
            median=float(np.median(each[name])) if name in each else None,
            max=float(each[name].max()) if name in each else None,
        )
        for name, total in run.metrics.seconds_per_stage.items()
    ]


def _stage_plots(run: StoredRun, stages: list[StageTime]) -> list[str]:
    plots = [inline_svg(draw_stage_bars({stage.name: stage.mean for stage in stages}), "stages")] if stages else []
    if run.frames is not None and (each := _seconds_per_frame(run)):
        stamps = run.frames.column("stamp").to_pylist()
        plots.append(inline_svg(draw_stages_over_time(stamps, each), "stages_over_time"))
    return plots


def _seconds_per_frame(run: StoredRun) -> dict[str, NDArray[np.float64]]:
    """Of each stage, shape (frames,); no stage where that is not known."""
    table = run.frames
    if table is None or not len(table):
        return {}
    prefix = "seconds_"
    names = [name for name in table.column_names if name.startswith(prefix)]
    return {name.removeprefix(prefix): table.column(name).to_numpy() for name in names}
