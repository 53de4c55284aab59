"""ATE with calibrated cameras on frames that were not used to calibrate them, as Markdown.

``python benchmarks/held_out.py --seqs demo`` makes the camera of each sequence wrong, calibrates it on the first half
of the frames, and runs the second half with the right, the wrong and the calibrated camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import columns
import torch
from changed_cameras import calibrate_changed_cameras
from command import add_sequences_option, make_parser, publish_rows
from replay import Replay
from storage import Row

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import InputError
from v3d_torch.evaluation import evaluate
from v3d_torch.evaluation.tables import format_median_and_range
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.pipeline import Pipeline
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM


def measure(source: str, config: Config, seeds: int) -> Iterator[Row]:
    """Yield a row per change."""
    right = load_sequence(source).camera
    with_right = ate_of_second_half(source, right, config, seeds)
    for change, given, calibration in calibrate_changed_cameras(source, config, first_half):
        accepted = ", ".join(each.name for each in calibration.estimates if each.accepted)
        yield {
            "sequence": Path(source).name,
            "change": change,
            "accepted": accepted or "nothing",
            "right": with_right,
            "given": with_right if given == right else ate_of_second_half(source, given, config, seeds),
            "calibrated": ate_of_second_half(source, calibration.camera, config, seeds),
        }


def first_half(sequence: RGBDSequence) -> RGBDSequence:
    """Return the first half of the frames."""
    return Replay(sequence, range(len(sequence) // 2))


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


def main() -> None:
    """Run all halves and print the table."""
    parser = make_parser("ATE with calibrated cameras on frames that were not used to calibrate them, as Markdown.")
    add_sequences_option(parser, "a right camera")
    parser.add_argument("--seeds", type=int, default=3, help="runs with each camera [3]")
    options = parser.parse_args()
    config = load_config(overrides=["segmentation.source=none"])
    publish_rows(parser, options, "held_out", columns.HELD_OUT, lambda source: measure(source, config, options.seeds))


if __name__ == "__main__":
    main()
