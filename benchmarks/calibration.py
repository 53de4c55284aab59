"""Calibration of cameras from deliberately wrong camera files, compared with the right values, as Markdown.

``python benchmarks/calibration.py --seqs demo crowd_rpy`` changes the camera of each sequence, calibrates it as
``v3d-torch calibrate`` does, and compares each parameter with the camera before the change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import columns
from changed_cameras import calibrate_changed_cameras
from command import add_sequences_option, make_parser, publish_rows
from sequences import table_name
from storage import Row

from v3d_torch.calibration.parameters import DISTORTION, get_values
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence


def measure(source: str, config: Config) -> Iterator[Row]:
    """Yield a row per change and parameter."""
    sequence = load_sequence(source)
    right = sequence.camera
    for changed in calibrate_changed_cameras(source, config):
        for each in changed.calibration.estimates:
            if each.name in DISTORTION:  # few recordings determine it, and the right value is rarely known
                continue
            (truth,) = get_values(right, math.nan if right.readout is None else right.readout, [each.name])
            yield {
                "sequence": table_name(sequence),
                "change": changed.change,
                "parameter": each.name,
                "right": "unknown" if math.isnan(truth) else f"{truth:.6g}",
                "given": "unknown" if each.given is None else f"{each.given:.6g}",
                "estimated": f"{each.value:.5g} +- {each.sigma:.2g}" if math.isfinite(each.sigma) else "-",
                "result": "accepted" if each.accepted else f"not used: {each.reason}",
            }


def main() -> None:
    """Calibrate all cameras and print the table."""
    parser = make_parser("Calibration of cameras from deliberately wrong camera files, as Markdown.")
    add_sequences_option(parser, "a right camera")
    config = load_config(overrides=["segmentation.source=none"])
    publish_rows(
        parser, parser.parse_args(), "calibration", columns.CALIBRATION, lambda source: measure(source, config)
    )


if __name__ == "__main__":
    main()
