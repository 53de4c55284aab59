"""What the network may cost less by, and what that loses, as Markdown.

``python benchmarks/segmentation.py --seqs walkers_desk crowd_rpy`` runs each sequence with the network in other
precisions, sizes and models, and with the network on every second or third frame only; in between, what was seen is
predicted as a missed object is. Where a sequence has true masks, the whole system is scored by them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from statistics import median

from command import command_line, publish
from heading import heading
from sequences import located
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.evaluation import evaluate
from v3d_torch.evaluation.tables import row
from v3d_torch.pipeline import Pipeline
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation import make_segmenter
from v3d_torch.segmentation.coco import PERSON
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame, Segmenter, segment_frame

SERIAL = ("prefetch=false",)  # as in v3d_torch/cli/run.py

REFERENCE = "yolov8n 640x480, 32 bits"
FULL = ("segmentation.width=640", "segmentation.height=480")


@dataclass(frozen=True)
class Variant:
    """A way to segment: values over the defaults, and the network on every n-th frame."""

    overrides: tuple[str, ...] = ()
    every: int = 1


VARIANTS: Mapping[str, Variant] = {
    REFERENCE: Variant((*FULL, "segmentation.precision=float32")),
    "8 bits, 640x480": Variant(FULL),
    "8 bits, 512x384": Variant(("segmentation.width=512", "segmentation.height=384")),
    "8 bits, 416x320 (the default)": Variant(),
    "8 bits, 320x256": Variant(("segmentation.width=320", "segmentation.height=256")),
    "8 bits, yolo11n": Variant(("segmentation.model=yolo11n-seg",)),
    "8 bits, yolo26n": Variant(("segmentation.model=yolo26n-seg",)),
    "8 bits, every 2nd frame": Variant(every=2),
    "8 bits, every 3rd frame": Variant(every=3),
}


@dataclass
class Watched:
    """A segmenter that works on every n-th frame, is timed, and remembers where it saw people."""

    segment: Segmenter
    every: int
    seconds: list[float] = field(default_factory=list)
    people: dict[int, Tensor] = field(default_factory=dict)

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Segment a frame without a pose."""
        return self.segment_with_pose(frame, None)

    def segment_with_pose(self, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
        """Segment every n-th frame; the frames in between have no instances."""
        if frame.index % self.every:
            return Instances.empty(*frame.image.shape[1:])
        begin = time.perf_counter()
        instances = segment_frame(self.segment, frame, T_cw)
        self.seconds.append(time.perf_counter() - begin)
        self.people[frame.index] = instances.masks[instances.labels == PERSON].any(dim=0)
        return instances


def compare(sequence: RGBDSequence) -> Iterator[str]:
    """A row per variant."""
    columns = ["network", "ms a frame", "people's pixels found", "moving left out", "static left out", "ids", "ATE, m"]
    yield row(columns)
    yield row(["---"] + ["---:"] * (len(columns) - 1))
    reference: dict[int, Tensor] = {}
    for name, variant in VARIANTS.items():
        config = load_config(overrides=[*SERIAL, *variant.overrides])
        set_num_threads(config.threads)
        watched = Watched(make_segmenter(config.segmentation), variant.every)
        pipeline = Pipeline(sequence, V3DSLAM(sequence.camera, watched, config))
        run = pipeline()
        if run.failure is not None:
            raise RuntimeError(run.failure)
        reference = reference or watched.people
        found = sum(int((seen & reference[index]).sum()) for index, seen in watched.people.items())
        there = sum(int(reference[index].sum()) for index in watched.people)
        scores = run.mask_evaluation.scores()
        truth = sequence.groundtruth
        yield row(
            [
                name,
                f"{1e3 * median(watched.seconds) / variant.every:.0f}",
                told(found / there if there else None, ".1%"),
                told(scores and scores.moving_left_out, ".1%"),
                told(scores and scores.static_left_out, ".1%"),
                told(scores and scores.id_changes_per_60_frames, ".2f"),
                told(truth and evaluate(truth, pipeline.slam.poses.trajectory(), frames=len(sequence)).ate.rmse, ".4f"),
            ]
        )


def told(value: float | None, form: str) -> str:
    """A figure as text, where there is one."""
    return "-" if value is None else format(value, form)


def page(options: argparse.Namespace) -> Iterator[str]:
    """The whole document."""
    yield "# What the network costs and finds"
    yield ""
    yield from heading()
    for name in options.seqs:
        yield ""
        yield f"## {name}"
        yield ""
        yield from compare(load_sequence(located(name, options.data_root)))
    yield ""
    yield (
        f"ms a frame: of one core, with turning, decoding and, at first, looks at all four turns. People's pixels: of"
        f" those that {REFERENCE}, finds on the same frames. Left out: of the true moving and static pixels with depth,"
        f" by the whole system. ids: changes of a person's id in 60 frames."
    )


def main() -> None:
    """Run the command line."""
    parser = command_line("What the network costs and finds, in other precisions, sizes and rates")
    parser.add_argument("--seqs", nargs="+", default=["walkers_desk", "crowd_rpy"], help="sequences with true masks")
    options = parser.parse_args()
    try:
        publish(page(options), options, parser)
    except V3DError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
