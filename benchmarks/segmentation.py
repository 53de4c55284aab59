"""Cost and accuracy of smaller and faster segmentation networks, and of segmentation of fewer frames, as Markdown.

``python benchmarks/segmentation.py --seqs walkers_desk crowd_rpy`` runs each sequence with the network in other
precisions, sizes and models, and with the network on every second or third frame only; in between, masks are
propagated (``segmentation.interval``). If a sequence has true masks, the whole system is scored with them.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from statistics import median

import columns
from command import make_parser, publish
from heading import make_heading
from sequences import locate_sequence, table_name
from storage import Measurement, Row
from tables import flat
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.evaluation import evaluate
from v3d_torch.pipeline import Pipeline
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation import make_segmenter
from v3d_torch.segmentation.coco import PERSON
from v3d_torch.segmentation.segmenter import segment_frame
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame, Segmenter

SERIAL = ("prefetch=false",)  # as in v3d_torch/cli/run.py

REFERENCE = "yolov8n 640x480, 32 bits"
FULL = ("segmentation.width=640", "segmentation.height=480")


VARIANTS: Mapping[str, tuple[str, ...]] = {
    REFERENCE: (*FULL, "segmentation.precision=float32"),
    "8 bits, 640x480": FULL,
    "8 bits, 512x384": ("segmentation.width=512", "segmentation.height=384"),
    "8 bits, 416x320 (the default)": (),
    "8 bits, 320x256": ("segmentation.width=320", "segmentation.height=256"),
    "8 bits, yolo11n": ("segmentation.model=yolo11n-seg",),
    "8 bits, yolo26n": ("segmentation.model=yolo26n-seg",),
    "8 bits, every 2nd frame": ("segmentation.interval=2",),
    "8 bits, every 3rd frame": ("segmentation.interval=3",),
}
"""Configuration values over the defaults, by the name of the variant."""


@dataclass
class MeasuredSegmenter:
    """Segmenter that stores its times and the masks of people.

    Attributes:
        segment: Segmenter to run.
        seconds: Time of each of its runs, seconds.
        people: Union of the masks of people by frame index, bool, shape :math:`(H, W)`.
    """

    segment: Segmenter
    seconds: list[float] = field(default_factory=list)
    people: dict[int, Tensor] = field(default_factory=dict)

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Segment a frame without a pose."""
        return self.segment_with_pose(frame, None)

    def segment_with_pose(self, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
        """Segment a frame, and store the time and the people."""
        begin = time.perf_counter()
        instances = segment_frame(self.segment, frame, T_cw)
        self.seconds.append(time.perf_counter() - begin)
        self.people[frame.index] = instances.masks[instances.labels == PERSON].any(dim=0)
        return instances


def compare(sequence: RGBDSequence) -> Iterator[Row]:
    """Yield a row per variant."""
    reference: dict[int, Tensor] = {}
    for name, overrides in VARIANTS.items():
        config = load_config(overrides=[*SERIAL, *overrides])
        set_num_threads(config.threads)
        segmenter = MeasuredSegmenter(make_segmenter(config, sequence.camera))
        pipeline = Pipeline(sequence, V3DSLAM(sequence.camera, segmenter, config))
        run = pipeline()
        if run.failure is not None:
            raise RuntimeError(run.failure)
        pipeline.flush()
        reference = reference or segmenter.people
        found = sum(int((people & reference[index]).sum()) for index, people in segmenter.people.items())
        expected = sum(int(reference[index].sum()) for index in segmenter.people)
        scores = run.mask_evaluation.compute_scores()
        truth = sequence.groundtruth
        ate = None
        if truth is not None:
            ate = evaluate(truth, pipeline.slam.poses.trajectory(), frames=len(sequence)).ate.rmse
        yield {
            "sequence": table_name(sequence),
            "network": name,
            "ms": f"{1e3 * median(segmenter.seconds) / config.segmentation.interval:.0f}",
            "people_found": format_value(found / expected if expected else None, ".1%"),
            "moving_masked": format_value(scores.moving_masked if scores else None, ".1%"),
            "static_masked": format_value(scores.static_masked if scores else None, ".1%"),
            "id_switches": format_value(scores.id_switches_per_60_frames if scores else None, ".2f"),
            "ate": format_value(ate, ".4f"),
        }


def format_value(value: float | None, form: str) -> str:
    """Format a value; a dash if there is none."""
    return "-" if value is None else format(value, form)


ABOUT = (
    "ms: wall time of one core per frame, including rotation, decoding and, at first, the network on all four"
    f" rotations. People's pixels: fraction of those that {REFERENCE}, finds on the same frames. Masked: fraction of"
    " the true moving and static pixels with depth that the whole system masks. ID switches: of a person, in 60 frames."
)


def main() -> None:
    """Run all variants and print the tables."""
    parser = make_parser("Cost and accuracy of segmentation networks, as Markdown")
    parser.add_argument("--seqs", nargs="+", default=["walkers_desk", "crowd_rpy"], help="sequences with true masks")
    options = parser.parse_args()
    heading = make_heading()
    lines = ["# Segmentation networks", "", *heading.lines()]
    rows: list[Row] = []
    try:
        for name in options.seqs:
            sequence_rows = list(compare(load_sequence(locate_sequence(name, options.data_root))))
            lines += ["", f"## {name}", "", *flat(sequence_rows, columns.SEGMENTATION)]
            rows += sequence_rows
    except V3DError as error:
        parser.error(str(error))
    publish([*lines, "", ABOUT], options, parser, {"segmentation": Measurement(heading, rows)})


if __name__ == "__main__":
    main()
