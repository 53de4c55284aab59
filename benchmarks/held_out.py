"""ATE with calibrated cameras on frames that were not used to calibrate them, as Markdown.

``python benchmarks/held_out.py --seqs demo`` makes the camera of each sequence wrong, calibrates it on the first half
of the frames, and runs the second half with the right, the wrong and the calibrated camera.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import columns
import torch
from calibration import CHANGES
from command import make_parser, publish
from heading import make_heading
from replay import Replay
from sequences import locate_sequence
from storage import Measurement, Row
from tables import flat

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import InputError, V3DError
from v3d_torch.evaluation import evaluate
from v3d_torch.evaluation.tables import format_median_and_range
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.calibration_run import calibrate_sequence
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM


def measure(source: str, config: Config, seeds: int) -> Iterator[Row]:
    """Yield a row per change."""
    right = load_sequence(source).camera
    with_right = ate_of_second_half(source, right, config, seeds)
    for name, change in CHANGES.items():
        given = change(right)

        def open_first_half(camera: PinholeCamera | None, given: PinholeCamera = given) -> RGBDSequence:
            sequence = load_sequence(source, camera=camera or given)
            return Replay(sequence, range(len(sequence) // 2))

        calibrated = calibrate_sequence(open_first_half, NoSegmentation, config, lambda *_: lambda *_: None)
        accepted = ", ".join(each.name for each in calibrated.estimates if each.accepted)
        yield {
            "sequence": Path(source).name,
            "change": name,
            "accepted": accepted or "nothing",
            "right": with_right,
            "given": with_right if given == right else ate_of_second_half(source, given, config, seeds),
            "calibrated": ate_of_second_half(source, calibrated.camera, config, seeds),
        }


def ate_of_second_half(source: str, camera: PinholeCamera, config: Config, seeds: int) -> str:
    """Return the median and the range over the seeds of the ATE RMSE with a camera, metres.

    Raises:
        InputError: If the sequence has no ground truth.
    """
    sequence = load_sequence(source, camera=camera)
    if sequence.groundtruth is None:
        raise InputError(f"{source}: has no ground truth; choose another sequence")
    errors = []
    for seed in range(seeds):
        torch.manual_seed(seed)
        half = Replay(sequence, range(len(sequence) // 2, len(sequence)))
        seeded = config.model_copy(update={"seed": seed})
        pipeline = Pipeline(half, V3DSLAM(camera, NoSegmentation(), seeded), evaluate_masks=False)
        pipeline()
        pipeline.flush()
        errors.append(evaluate(sequence.groundtruth, pipeline.slam.poses.trajectory()).ate.rmse)
    return format_median_and_range(errors, ".4f")


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = make_parser("ATE with calibrated cameras on frames that were not used to calibrate them, as Markdown.")
    parser.add_argument("--seqs", nargs="+", default=["demo"], help="sequences with a right camera [demo]")
    parser.add_argument("--seeds", type=int, default=3, help="runs with each camera [3]")
    return parser


def main() -> None:
    """Run all halves and print the table."""
    parser = arguments()
    options = parser.parse_args()
    heading = make_heading()
    config, rows = load_config(overrides=["segmentation.source=none"]), list[Row]()
    try:
        for name in options.seqs:
            rows += measure(locate_sequence(name, options.data_root), config, options.seeds)
    except V3DError as error:
        parser.error(str(error))
    lines = [*heading.lines(), "", *flat(rows, columns.HELD_OUT)]
    publish(lines, options, parser, {"held_out": Measurement(heading, rows)})


if __name__ == "__main__":
    main()
