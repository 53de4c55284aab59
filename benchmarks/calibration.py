"""Calibration of cameras from deliberately wrong camera files, compared with the right values, as Markdown.

``python benchmarks/calibration.py --seqs demo crowd_rpy`` changes the camera of each sequence, calibrates it as
``v3d-torch calibrate`` does, and compares each parameter with the camera before the change.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import columns
from command import make_parser, publish
from heading import make_heading
from sequences import locate_sequence
from storage import Measurement, Row
from tables import flat

from v3d_torch.calibration.parameters import DISTORTION, get_values
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.runs.calibration_run import calibrate_sequence
from v3d_torch.segmentation import NoSegmentation

CHANGES: dict[str, Callable[[PinholeCamera], PinholeCamera]] = {
    "nothing": lambda camera: camera,
    "focal lengths times 1.1": lambda camera: replace(camera, fx=1.1 * camera.fx, fy=1.1 * camera.fy),
    "centre moved by (15, 15)": lambda camera: replace(camera, cx=camera.cx + 15, cy=camera.cy + 15),
}
"""Changes of a camera by their names."""


def measure(source: str, config: Config) -> Iterator[Row]:
    """Yield a row per change and parameter."""
    right = load_sequence(source).camera
    for name, change in CHANGES.items():
        given = change(right)

        def open_sequence(camera: PinholeCamera | None, given: PinholeCamera = given) -> RGBDSequence:
            return load_sequence(source, camera=camera or given)

        calibration = calibrate_sequence(open_sequence, NoSegmentation, config, lambda *_: lambda *_: None)
        for each in calibration.estimates:
            if each.name in DISTORTION:  # few recordings determine it, and the right value is rarely known
                continue
            (truth,) = get_values(right, math.nan if right.readout is None else right.readout, [each.name])
            yield {
                "sequence": load_sequence(source).name,
                "change": name,
                "parameter": each.name,
                "right": "unknown" if math.isnan(truth) else f"{truth:.6g}",
                "given": "unknown" if each.given is None else f"{each.given:.6g}",
                "estimated": f"{each.value:.5g} +- {each.sigma:.2g}" if math.isfinite(each.sigma) else "-",
                "result": "accepted" if each.accepted else f"not used: {each.reason}",
            }


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = make_parser("Calibration of cameras from deliberately wrong camera files, as Markdown.")
    parser.add_argument("--seqs", nargs="+", default=["demo"], help="sequences with a right camera [demo]")
    return parser


def main() -> None:
    """Calibrate all cameras and print the table."""
    parser = arguments()
    options = parser.parse_args()
    heading = make_heading()
    config, rows = load_config(overrides=["segmentation.source=none"]), list[Row]()
    try:
        for name in options.seqs:
            rows += measure(locate_sequence(name, options.data_root), config)
    except V3DError as error:
        parser.error(str(error))
    lines = [*heading.lines(), "", *flat(rows, columns.CALIBRATION)]
    publish(lines, options, parser, {"calibration": Measurement(heading, rows)})


if __name__ == "__main__":
    main()
