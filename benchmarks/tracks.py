"""People's tracks beside trackers of boxes, scored with true masks, as Markdown.

``python benchmarks/tracks.py --seqs demo crowd_rpy`` runs each sequence once with the default configuration. The other
trackers get the people that the network finds in this run, with their scores.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import columns
import torch
from command import make_parser, publish
from heading import make_heading
from sequences import locate_sequence, table_name
from storage import Measurement, Row, file_of
from systems.box_trackers import PEERS, SETTINGS, BoxTracker
from tables import flat
from track_evaluation.motion import MotionErrors, MotionScores, format_scores
from track_evaluation.scores import FrameOverlap, TrackScores, frame_overlap, mask_overlap, score
from track_evaluation.truth import TruePeople, true_people

from v3d_torch.config import Config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.frame_result import FrameResult
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation import make_segmenter
from v3d_torch.segmentation.coco import PERSON
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame

SEQUENCES = ("demo", "crowd_static", "crowd_rpy", "walkers_desk", "walkers_room", "walkers_crowd")
"""Sequences with true masks."""

OURS = "v3d_torch"


@dataclass(frozen=True)
class TrackedFrame:
    """A frame of a run.

    Attributes:
        frame: Frame.
        people: People that the network found.
        result: Result of the frame.
    """

    frame: RGBDFrame
    people: Instances
    result: FrameResult


def run(sequence: RGBDSequence, config: Config, frames: int | None) -> Iterator[TrackedFrame]:
    """Run the system over the first frames of a sequence."""
    set_num_threads(config.threads)
    slam = V3DSLAM(sequence.camera, make_segmenter(config, sequence.camera), config)
    with torch.inference_mode():
        for index in range(len(sequence) if frames is None else frames):
            preprocessed = slam.preprocess(sequence[index], slam.predictions[0])
            slam.advance_predictions()
            frame, instances = preprocessed.frame, preprocessed.segmentation.instances
            if instances is None:  # the network does not see every frame
                instances = Instances.empty(*frame.image.shape[1:])
            yield TrackedFrame(frame, instances[instances.labels == PERSON], slam.track(preprocessed))


def compare(
    sequence: RGBDSequence, truth: Sequence[TruePeople], config: Config
) -> tuple[dict[str, TrackScores], MotionScores]:
    """Score our tracks and those of each peer with each setting, on the first frames of a sequence.

    Args:
        sequence: Sequence.
        truth: True people of the frames.
        config: Configuration of the system.

    Returns:
        Scores by name and setting, and the errors of our positions and velocities.
    """
    rate = (len(sequence) - 1) / float(sequence.stamps[-1] - sequence.stamps[0])
    settings = [(name, setting) for setting in SETTINGS for name in PEERS]
    trackers = {pair: BoxTracker(pair[0], SETTINGS[pair[1]][pair[0]], rate) for pair in settings}
    ours: list[FrameOverlap] = []
    motion = MotionErrors(sequence.camera.rays.numpy(), sequence.groundtruth)
    theirs: dict[tuple[str, str], list[FrameOverlap]] = {pair: [] for pair in settings}
    for people, tracked in zip(truth, run(sequence, config, len(truth)), strict=True):
        objects = [each for each in tracked.result.objects if each.label == PERSON]
        ours.append(frame_overlap(people, {each.id: mask_overlap(people, each.mask.numpy()) for each in objects}))
        states = {each.id: each.state for each in objects}
        motion.add(people, tracked.frame.depth, ours[-1], states, tracked.result.T_wc)
        overlaps = [mask_overlap(people, mask.numpy()) for mask in tracked.people.masks]
        for pair, tracker in trackers.items():
            ids = tracker(tracked.frame, tracked.people)
            theirs[pair].append(frame_overlap(people, {id_: overlaps[index] for id_, index in ids.items()}))
    scores = {OURS: score(ours)} | {f"{name}, {setting}": score(theirs[name, setting]) for name, setting in settings}
    return scores, motion.scores()


def score_rows(sequence: str, scores: dict[str, TrackScores], motion: MotionScores) -> Iterator[Row]:
    """Yield a row for our tracks and one for each peer with its best setting, by HOTA."""
    for tracker in (OURS, *PEERS):
        settings = [name for name in scores if name.startswith(tracker)]
        best = scores[max(settings, key=lambda name: scores[name].hota)]
        yield {
            "sequence": sequence,
            "tracker": tracker,
            "hota": f"{best.hota:.3f}",
            "deta": f"{best.deta:.3f}",
            "assa": f"{best.assa:.3f}",
            "idf1": f"{best.idf1:.3f}",
            "mota": f"{best.mota:.3f}",
            "id_switches": f"{best.id_switches_per_60_frames:.2f} ({best.id_switches})",
            "pixels_right": f"{best.pixels_right:.1%}",
            "tracks": f"{best.tracks} ({best.people})",
            **(format_scores(motion) if tracker == OURS else {}),
        }


ABOUT = (
    "Every mask of a person is compared with the true masks by intersection over union, those of the peers too: their"
    " tracks have the masks of the detections that they were given. Peers run with their defaults and with lower score"
    " thresholds; the better result is shown. Errors of position and velocity are medians of people fully in view: the"
    " true position is the mean of the visible surface in the true mask, the true velocity its change over half a"
    " second in the ground-truth world. A velocity from true positions is that of the last 0.3 s. Normalised errors are"
    " squared errors divided by the variances of the filter."
)


def main() -> None:
    """Run all sequences and print the table."""
    parser = make_parser("People's tracks beside trackers of boxes, as Markdown.")
    parser.add_argument("--seqs", nargs="+", default=list(SEQUENCES), help="sequences with true masks")
    parser.add_argument("--frames", type=int, help="number of first frames of each sequence [all]")
    parser.add_argument("--ids-as-given", action="store_true", help="do not correct the ids of the true masks")
    options = parser.parse_args()
    heading = make_heading(("trackeval", "trackers"))
    rows: list[Row] = []
    try:
        for name in options.seqs:
            sequence = load_sequence(locate_sequence(name, options.data_root), data_root=options.data_root)
            truth = true_people(sequence, options.frames, correct_ids=not options.ids_as_given)
            rows += score_rows(table_name(sequence), *compare(sequence, truth, Config()))
    except V3DError as error:
        parser.error(str(error))
    lines = ["# Tracks of people", "", *heading.lines(), "", *flat(rows, columns.TRACKS), "", ABOUT]
    publish(lines, options, parser, {file_of("tracks"): Measurement(heading, rows)})


if __name__ == "__main__":
    main()
