"""Sections of ``docs/benchmarks.md``: the text, the table and the measurements of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import columns
from descriptions import about_peers, sequence_notes
from storage import Measurement
from tables import (
    VARIANTS,
    accuracy_table,
    bullets,
    design_tables,
    flat,
    network_tables,
    notes,
    objects_table,
    pivot,
    provenance,
    rows_of,
    speed_table,
    tracks_table,
)

Table = Callable[[Sequence[Measurement]], Iterable[str]]
"""Function that writes the lines of a table, or the remarks below it."""


def flat_table(names: Mapping[str, str]) -> Table:
    """Make a function that writes a line per row; `names` are the headings of the columns by cell."""
    return lambda measurements: flat(rows_of(measurements), names)


def pivot_table(index: str, value: str, names: Mapping[str, str] | None = None) -> Table:
    """Make a function that writes a column per sequence; see `pivot`."""
    return lambda measurements: pivot(rows_of(measurements), index, "sequence", value, names)


def accuracy_remarks(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the source of published values, and notes on measurements and sequences."""
    yield f"ORB-SLAM2, ORB-SLAM3, NGD-SLAM: {about_peers()}"
    yield from notes(measurements)
    yield from (f"{name}: {note}" for note, name in sequence_notes())


def no_remarks(_: Sequence[Measurement]) -> Iterable[str]:
    """Return nothing."""
    return ()


@dataclass(frozen=True)
class Part:
    """A text, a table, and how the table was measured.

    Attributes:
        file: Name of the file of the measurements in ``benchmarks/results``.
        text: Paragraph above the table.
        table: Writes the lines of the table.
        key: Cell that distinguishes the rows of several measurements.
        remarks: Texts of the list items below the provenance.
        shows_provenance: False if each row of the table says when it was measured.
    """

    file: str
    text: str
    table: Table
    key: str | None = None
    remarks: Table = notes
    shows_provenance: bool = True

    def lines(self, measurements: Sequence[Measurement]) -> Iterator[str]:
        """Yield the lines of the part, the first one empty."""
        yield from ("", self.text, "", *self.table(measurements))
        below = [*provenance(measurements, self.key)] if self.shows_provenance else []
        below += bullets(self.remarks(measurements))
        if below:
            yield from ("", *below)


SECTIONS: dict[str, tuple[Part, ...]] = {
    "Accuracy": (
        Part(
            "accuracy",
            (
                "ATE RMSE in metres, lower is better; the lowest value of a row is bold. `full` is the default"
                " configuration, `realtime` is `--config realtime`, which segments every second frame, and `baseline`"
                " is `--segmenter none`. ORB-SLAM3 (PyPI) is pyorbslam3 with a vocabulary trained on the sequences;"
                " it is not deterministic. A system that skips hard frames has a lower error, so coverage is given if"
                " it is below 100%. Parameters of v3d_torch were chosen on these sequences; the other systems have"
                " their default parameters, but not their vocabularies (below). Results on the same sequences played"
                " backwards, mirrored, or with changed images are below"
                " ([design choices](#sequences-on-which-no-parameter-was-chosen))."
            ),
            accuracy_table,
            key="system",
            remarks=accuracy_remarks,
        ),
    ),
    "Degraded images": (
        Part(
            "degraded",
            (
                "ATE if each sequence has fewer frames, less light, blur, noisier depth or a lower resolution. Both"
                " systems have their defaults, and read the same files."
            ),
            flat_table(columns.DEGRADED),
        ),
    ),
    "Speed": (
        Part(
            "speed",
            (
                "Frames per second, higher is better, and in parentheses CPU ms per frame: user and system time of all"
                " threads and processes, lower is better. The last columns compare frames per second with ORB-SLAM3 in"
                " the same turn. Images of 640x480 pixels are read and decoded within the time; systems take turns."
            ),
            speed_table,
            key="system",
        ),
        Part(
            "stages",
            (
                "Time of each stage, ms per frame. Stages run in parallel with those of the next frame, so that the"
                " sum can exceed the time of a frame. `bundle` is local bundle adjustment."
                " `v3d-torch run --profile` prints such a table for any run."
            ),
            pivot_table("stage", "ms"),
        ),
        Part(
            "speed_float32",
            (
                "The same on a processor without 8-bit vector instructions, where the network runs in 32 bits. It is"
                " slower in everything else too: only the ratios can be compared with those above."
            ),
            speed_table,
            key="system",
        ),
        Part("stages_float32", "Time of each stage on that processor, ms per frame.", pivot_table("stage", "ms")),
    ),
    "Growth": (
        Part(
            "growth",
            (
                "A sequence is played again and again. Time per frame and number of keyframes should stay constant,"
                " because the camera observes the same room. CPU ms per frame is given for each tenth of the run, and"
                " relative to that of new systems, which process the first 300 frames before and after each tenth: a"
                " slower machine makes both slower."
            ),
            flat_table(columns.GROWTH),
            key="frames",
        ),
        Part(
            "keyframes",
            (
                "Place recognition and pose graph alone, on synthetic keyframes: a query of the keyframe database, and"
                " a loop over all keyframes. Both times should grow slowly with the number of keyframes."
            ),
            flat_table(columns.KEYFRAMES),
        ),
    ),
    "Live": (
        Part(
            "live",
            (
                "Stored sequences at their own rate, as a camera sends them: `v3d-torch run --config realtime"
                " --realtime`. The latency is the time from the capture of a frame to its first pose, which `pose_at`"
                " knows from the motion since the previous frame, and to its result with objects and the pose in the"
                " map. The last column is the ATE of the same configuration if no frame is dropped."
            ),
            flat_table(columns.LIVE),
        ),
    ),
    "Recovery of a lost camera": (
        Part(
            "lost",
            (
                "The camera is covered, frames are dropped, or the camera is moved elsewhere and back. A case passes"
                " if the camera is recovered within 10 frames at a known place, no covered frame is tracked, the ATE"
                " is at most 1.5 times that of the uninterrupted run, and no pose reported as reliable is wrong by"
                " more than 0.1 m."
            ),
            flat_table(columns.LOST),
            key="sequence",
        ),
    ),
    "Calibration": (
        Part(
            "calibration",
            (
                "`v3d-torch calibrate --segmenter none` estimates the camera from the images, starting with a"
                " deliberately wrong camera file. An estimate is accepted if the recording determines it within its"
                " tolerance, and if it differs significantly from the given value. The right values of a recording are"
                " those of its data set, which can differ by some pixels from the truth."
            ),
            flat_table(columns.CALIBRATION),
            key="sequence",
        ),
        Part(
            "held_out",
            (
                "The camera is calibrated on the first half of the frames. ATE RMSE of the second half, which was not"
                " used, without masks: median and range over the seeds."
            ),
            flat_table(columns.HELD_OUT),
            key="sequence",
        ),
    ),
    "Learnt parameters": (
        Part(
            "feature_uncertainty",
            (
                "A small network predicts the uncertainty of each feature from its patch of image and depth"
                " (`notebooks/learn_feature_uncertainty.ipynb`). It is trained on other sequences. ATE RMSE with the"
                " true masks of people: median and range over the seeds; each seed trains its own network. Learnt from"
                " the demo, it lowers the error on the other rendered sequences with every seed. On real images it does"
                " not help. The poses of real pairs are wrong by several times more than those of the demo, so that"
                " other errors than the noise of features probably dominate. All uncertainties are equal by default. Of"
                " fr1_rpy, only frames that walkers_desk does not show are used; the people of the composed sequences"
                " and of crowd_static are of one recording."
            ),
            flat_table(columns.FEATURE_UNCERTAINTY),
        ),
        Part(
            "voting_thresholds",
            (
                "Distance threshold and number of votes, learnt from tracked objects of other sequences"
                ' (`notebooks/learn_voting_thresholds.ipynb`). Scores of "is dynamic" over all detected objects of all'
                " frames, with votes alone, without the free-space check, and with the free-space check of the default"
                " configuration. The objects are found by the network; an object truly moves if more than half of its"
                " pixels do. With votes alone, the larger threshold finds fewer moving objects and is more often right,"
                " which helps on one sequence and harms on the other; the free-space check confirms votes anyway, so"
                " that nothing is gained. The default stays. All composed sequences show people of one recording."
            ),
            flat_table(columns.VOTING_THRESHOLDS),
        ),
    ),
    "Plausibility of camera and depth": (
        Part(
            "plausibility",
            (
                "The camera file, the depth images or the colour images of each sequence are changed, and its first"
                " frames are run. The check should find the change, and nothing in the original sequence. A camera"
                " that stands still determines neither its focal length nor a delay of depth. The published depth of"
                " 7-Scenes (walkers_room, walkers_crowd) seems to be shifted by about (28, 3) pixels; this is not"
                " significant in so few views, but it hides a delay."
            ),
            pivot_table("change", "result"),
            key="sequence",
        ),
    ),
    "Covariance of poses": (
        Part(
            "consistency",
            (
                "Normalised estimation error squared (NEES) of the poses at each frame, without later corrections."
                " Below its expectation, the covariance is too large; above it, too small. World, mounting on the"
                " camera and clock of the ground truth are calibrated, 13 numbers for all poses, which takes away"
                " errors that all poses share, such as that of the first camera. The noise of a motion capture system"
                " that is faster than the camera is measured from its poses and added to the covariance; its slower"
                " errors are not known. Of the composed sequences, walkers_desk has the motion capture of fr1_rpy, at"
                " the times of the frames only, and crowd_rpy the exact poses of a virtual camera. The bounds of the"
                " mean account for the autocorrelation of the errors."
            ),
            flat_table(columns.CONSISTENCY),
            key="sequence",
        ),
    ),
    "Objects: masks and ids": (
        Part(
            "ablation",
            (
                "Moving masked: fraction of the true moving pixels with depth that tracking does not use, higher is"
                " better. Static masked: the same for static pixels, lower is better. ID switches: number of times"
                " that a person in view gets another ID, per 60 frames, lower is better. Each cell has the three"
                " values in this order."
            ),
            objects_table,
            remarks=no_remarks,
        ),
        Part(
            "ablation_float32",
            "The same on a processor without 8-bit vector instructions, where the network runs in 32 bits.",
            objects_table,
            remarks=no_remarks,
        ),
    ),
    "Tracks of people": (
        Part(
            "tracks",
            (
                "HOTA with its detection and association accuracy, IDF1 and MOTA by TrackEval, on masks: higher is"
                " better. ID switches in 60 frames in which a person is in view, lower is better. People's pixels in"
                " the right track: fraction of the true pixels of people that lie in the one track of this person."
                " ByteTrack, OC-SORT and BoT-SORT are those of the package `trackers`, with the same detections; the"
                " better of two settings is shown. The best HOTA and IDF1 of a sequence are bold. A true velocity is"
                " the change of the true position over half a second, which ends a quarter of a second after the frame."
                " From true positions: the error of the velocity that fits those of the last 0.3 s. A true position is"
                " the mean of the voxels of the visible surface."
            ),
            tracks_table,
            key="sequence",
        ),
        Part(
            "tracks_float32",
            "The same on a processor without 8-bit vector instructions, where the network runs in 32 bits.",
            tracks_table,
            key="sequence",
        ),
    ),
    "Segmentation networks": (
        Part(
            "segmentation",
            (
                "People's pixels found: relative to the pixels that the network with 32 bits at 640x480 finds on the"
                " same frames. The columns after it score the whole system as in the section on objects. ms: time of"
                " one core per frame. If the network runs on every second or third frame, objects are predicted in"
                " between."
            ),
            network_tables,
        ),
    ),
    "Maps": (
        Part(
            "maps",
            (
                "Points of the coloured map that belong to people, by the true masks, without and with the free-space"
                ' check; fewer are better. The check also removes some static points ("static points lost").'
            ),
            flat_table(columns.MAPS),
            key="sequence",
        ),
        Part(
            "map_costs",
            ("CPU time and size of the map, the mesh and the map file."),
            flat_table(columns.MAP_COSTS),
            key="sequence",
        ),
    ),
    "Occupancy map": (
        Part(
            "occupancy",
            (
                "The map of the demo, with estimated poses and masks, compared with the exact surfaces of the room. A"
                " voxel contains a surface even if the surface only touches a corner of it and is hardly visible; a"
                " sample represents 64 pixels. Unknown space is excluded from all rows."
            ),
            flat_table(columns.OCCUPANCY),
        ),
        Part(
            "occupancy_costs",
            (
                "Time of the stage in the system, and of OctoMap (octomap-python) for the insertion of the same views;"
                " memory of voxels and stored views; size of the files; time of queries."
            ),
            flat_table(columns.OCCUPANCY_COSTS),
            key="sequence",
        ),
    ),
    "Ablation": (
        Part(
            "ablation",
            (
                "ATE RMSE in metres without each part of the system, lower is better. Many differences are smaller"
                " than the range over the seeds. [ablate](commands/ablate.md) describes the variants."
            ),
            pivot_table("variant", "ate", VARIANTS),
        ),
        Part(
            "ablation_float32",
            "The same on a processor without 8-bit vector instructions, where the network runs in 32 bits.",
            pivot_table("variant", "ate", VARIANTS),
        ),
    ),
    "Primitives of the object stage": (
        Part(
            "primitives",
            (
                "Median time; ratio: time of the implementation divided by ours in the same turn, above 1 if ours is"
                " faster."
            ),
            flat_table(columns.PRIMITIVES),
        ),
    ),
    "Camera modules": (
        Part(
            "modules",
            (
                "Median time of a batch with one thread; ratio: time of the implementation divided by ours in the"
                " same turn, above 1 if ours is faster. Calls shorter than 20 ms are repeated within a turn."
                " Implementations without batches solve the problems one after the other. Our RANSACs take their"
                " samples from OpenCV's USAC and refine the result. Factor graphs of GTSAM and theseus are built"
                " beforehand, outside of the time. Errors are medians over the batch: of poses, millimetres and"
                " milliradians in one number; of `bundle_adjust`, millimetres of positions, aligned with their scale,"
                " which pixels do not determine; of essential matrices, thousandths of their norm; of matches, the"
                " percentage that is missing; of gradients, the difference to ours, %; of `umeyama`, the difference to"
                " evo, thousandths. A problem that kornia-rs's bundle adjustment cannot solve keeps its initial poses:"
                " one of the batch of 8, none of the other batches."
            ),
            flat_table(columns.MODULES),
        ),
    ),
    "Design choices": (
        Part(
            "design_choices",
            (
                "Single measurements that led to a choice, by topic. Each compares the choice with its alternative at"
                " one commit; no script repeats them. If the commit of the measurement is not known, the commit that"
                " recorded it is given."
            ),
            design_tables,
            remarks=no_remarks,
            shows_provenance=False,
        ),
    ),
}
"""Parts of each section by its title, in the order of the page."""


def section_lines(title: str, results: Mapping[str, Sequence[Measurement]]) -> Iterator[str]:
    """Yield the lines of a section, the first one empty; parts without measurements are left out.

    Args:
        title: Title of the section, a key of `SECTIONS`.
        results: Measurements by the name of their file.
    """
    measured = [(part, results[part.file]) for part in SECTIONS[title] if results.get(part.file)]
    if measured:
        yield from ("", f"## {title}")
    for part, measurements in measured:
        yield from part.lines(measurements)
