"""Result of a calibration as a commented camera file and as a table."""

from __future__ import annotations

import math

from rich.table import Table

from v3d_torch.calibration.camera_calibration import Calibration
from v3d_torch.calibration.parameters import DISTORTION
from v3d_torch.calibration.selection import Estimate
from v3d_torch.datasets.camera_text import camera_text
from v3d_torch.io.text import printable

UNITS = {
    **dict.fromkeys(("fx", "fy", "cx", "cy"), "{}, pixels"),
    **dict.fromkeys(("readout", "depth_delay"), "{}, s"),
    "inverse_depth_offset": "{}, 1/m",
    "depth_scale": "{}, units/m",
}
"""Names of the parameters with their units."""


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
