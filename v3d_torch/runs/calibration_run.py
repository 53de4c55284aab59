"""Calibration of the camera of a sequence: runs are repeated with the calibrated camera until it converges."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from rich.table import Table

from v3d_torch.calibration.camera_calibration import Calibration, calibrate_camera
from v3d_torch.calibration.parameters import DISTORTION
from v3d_torch.calibration.selection import Estimate
from v3d_torch.config import Config
from v3d_torch.datasets.base import RGBDSequence
from v3d_torch.datasets.camera_text import camera_text
from v3d_torch.errors import RunError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.text import printable
from v3d_torch.pipeline import FrameCallback, Pipeline
from v3d_torch.runs.system import check_map_is_given, make_system
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.types import Segmenter

_MAX_RUNS = 4
"""Maximum number of runs. With a wrong focal length matches are missing; the next run with a better one finds more."""

_CONVERGED = 0.5
"""Maximum change of an estimate between two runs at convergence, in standard deviations."""

_MIN_PIXEL_SIGMA = 1.0
"""Minimum standard deviation of the position of a feature in the runs, pixels: a wrong camera adds to the errors, and
with a smaller one the landmarks that show how it is wrong would be outliers."""

UNITS = {
    **dict.fromkeys(("fx", "fy", "cx", "cy"), "{}, pixels"),
    **dict.fromkeys(("readout", "depth_delay"), "{}, s"),
    "inverse_depth_offset": "{}, 1/m",
    "depth_scale": "{}, units/m",
}
"""Names of the parameters with their units."""


def calibrate_sequence(
    sequence: RGBDSequence,
    reopen: Callable[[PinholeCamera], RGBDSequence],
    make_segmenter: Callable[[PinholeCamera], Segmenter],
    config: Config,
    on_run: Callable[[int, int], FrameCallback],
) -> Calibration:
    """Calibrate the camera of a sequence.

    Args:
        sequence: Sequence with the given camera.
        reopen: Function that opens the sequence with another camera.
        make_segmenter: Function that makes the segmenter of a run with this camera.
        config: Configuration. The runs raise ``tracking.pixel_sigma`` to at least a pixel, and each later run has the
            next seed.
        on_run: Called before each run with its number, from 1, and the number of frames; returns a function that is
            called after each frame.

    Raises:
        RunError: If a frame cannot be read.
        ConfigError: If the configuration does not map, or as `make_segmenter` raises it.
    """
    check_map_is_given(config)
    set_num_threads(config.threads)
    given = camera = sequence.camera
    previous: Calibration | None = None
    for number in range(1, _MAX_RUNS + 1):
        config_of_run = _config_of_run(config, number)
        torch.manual_seed(config_of_run.seed)
        slam = make_system(camera, make_segmenter(camera), config_of_run)
        pipeline = Pipeline(sequence, slam, evaluate_masks=False)
        record = pipeline(on_run(number, len(sequence)))
        if record.failure is not None:
            raise RunError(record.failure)
        pipeline.flush()
        calibration = calibrate_camera(
            pipeline.slam.map,
            pipeline.views,
            pipeline.slam.poses.trajectory(),
            sequence.groundtruth,
            camera,
            given,
            config_of_run,
        )
        if number == _MAX_RUNS or _is_converged(calibration, camera, previous):
            break
        previous, camera = calibration, calibration.next_camera
        sequence = reopen(camera)
    return calibration


def _config_of_run(config: Config, number: int) -> Config:
    """Return the configuration of a run, by its number from 1: with other random samples than in the runs before."""
    sigma = max(config.tracking.pixel_sigma, _MIN_PIXEL_SIGMA)
    tracking = config.tracking.model_copy(update={"pixel_sigma": sigma})
    return config.model_copy(update={"tracking": tracking, "seed": config.seed + number - 1})


def _is_converged(calibration: Calibration, camera: PinholeCamera, previous: Calibration | None) -> bool:
    """Check whether the last two runs gave the same values, up to a fraction of their uncertainty.

    Args:
        calibration: Calibration from the last run.
        camera: Camera of the last run.
        previous: Calibration from the run before; None after the first run.
    """
    accepted, before = calibration.accepted, {} if previous is None else previous.accepted
    if "fx" not in accepted and (previous is None or calibration.next_camera.fx != camera.fx):
        return False  # other focal lengths explain the images better, or other random samples could show them
    return accepted.keys() == before.keys() and all(
        abs(each.value - before[name].value) <= _CONVERGED * each.sigma for name, each in accepted.items()
    )


def calibration_text(calibration: Calibration, name: str) -> str:
    """Return the text of a camera file with the uncertainty of each value as a comment.

    Args:
        calibration: Calibrated camera.
        name: Name of the sequence.
    """
    comments: dict[str, list[str]] = {}
    for each in calibration.estimates:
        field = "distortion" if each.name in DISTORTION else each.name
        comments.setdefault(field, []).append(
            f"{each.name} {_describe(each)}" if field != each.name else _describe(each)
        )
    heading = (
        f"# Calibrated by v3d-torch calibrate from {printable(name)}. A value is replaced only if the recording"
        " determines it; the comment states why the others were kept.\n"
    )
    return heading + camera_text(calibration.camera, {field: "; ".join(texts) for field, texts in comments.items()})


def calibration_table(calibration: Calibration) -> Table:
    """Return a table of all parameters: given value, estimate, standard deviation, and result."""
    table = Table(title="camera")
    table.add_column("parameter", no_wrap=True)
    for column in ("given", "estimated", "+-", "result"):
        table.add_column(column, justify="left" if column == "result" else "right", overflow="fold")
    for each in calibration.estimates:
        given = "unknown" if each.given is None else f"{each.given:.6g}"
        is_known = math.isfinite(each.sigma) and math.isfinite(each.value)
        value, sigma = _format(each.value, each.sigma) if is_known else ("-", "-")
        result = "accepted" if each.accepted else f"not used: {each.reason}"
        table.add_row(UNITS.get(each.name, "{}").format(each.name), given, value, sigma, result)
    return table


def _format(value: float, sigma: float) -> tuple[str, str]:
    """Format a value and its standard deviation in fixed point, both rounded to the second digit of the deviation."""
    if sigma == 0:
        return f"{value:.6g}", "0"
    decimals = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))  # rounded first, because 9.99 becomes 10
    rounded = (round(each, decimals) + 0.0 for each in (value, sigma))  # + 0.0, because -0.0 would have a sign
    text, sigma_text = (f"{each:.{max(decimals, 0)}f}" for each in rounded)
    return text, sigma_text


def _describe(estimate: Estimate) -> str:
    """Describe an estimate in a few words, for a comment."""
    if not math.isfinite(estimate.sigma) or not math.isfinite(estimate.value):
        return f"not used: {estimate.reason}"
    value = " +- ".join(_format(estimate.value, estimate.sigma))
    if not estimate.accepted:
        return f"not used: {estimate.reason} ({value})"
    given = "unknown" if estimate.given is None else f"{estimate.given:.6g}"
    return f"{value}, given {given}"
