"""Sections of ``docs/benchmarks.md``, each made of the measurements of one or two benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import columns
from descriptions import PEERS, kind, sequence_notes
from storage import Measurement, Row
from tables import accuracy_table, bullets, flat, mark_highest, notes, pivot, provenance, rows_of, speed_table, unique

VARIANTS = {
    "baseline": "no masks",
    "no_voting": "no votes",
    "no_chamfer": "no Chamfer distance",
    "no_prediction": "no prediction of missed objects",
    "no_unlabelled": "no unlabelled instances",
    "not_upright": "images not rotated upright",
    "global_shutter": "no model of the rolling shutter",
    "paper": "the paper's literal rules",
    "full": "full",
}
"""Names of the variants of the ablation study in tables."""


def part(
    text: str,
    table: Iterable[str],
    measurements: Sequence[Measurement] = (),
    key: str | None = None,
    remarks: Iterable[str] | None = None,
) -> Iterator[str]:
    """Yield a part of a section: a text, a table, and how the table was measured.

    Args:
        text: Paragraph above the table.
        table: Lines of the table.
        measurements: Measurements of the table.
        key: Cell that distinguishes the rows of several measurements.
        remarks: List items below the provenance of the measurements; None for their notes.
    """
    yield from ("", text, "", *table)
    below = [*provenance(measurements, key), *(bullets(notes(measurements)) if remarks is None else remarks)]
    if below:
        yield from ("", *below)


def accuracy_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on accuracy."""
    yield "## Accuracy"
    text = (
        "ATE RMSE in metres, lower is better; the lowest value of a row is bold. `full` is the default"
        " configuration, `baseline` is `--segmenter none`. ORB-SLAM3 (PyPI) is pyorbslam3 with a vocabulary trained"
        " on the sequences; it is not deterministic. A system that skips hard frames has a lower error, so coverage is"
        " given if it is below 100%."
    )
    remarks = [
        f"- ORB-SLAM2, ORB-SLAM3, NGD-SLAM: {PEERS['about']}",
        *bullets(notes(measurements)),
        *(f"- {name}: {note}" for note, name in sequence_notes()),
    ]
    yield from part(text, accuracy_table(measurements), measurements, "system", remarks)


def speed_section(measurements: Sequence[Measurement], stages: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on speed."""
    yield "## Speed"
    text = (
        "Frames per second, higher is better, and in parentheses CPU ms per frame: user and system time of all"
        " threads and processes, lower is better. The last columns compare frames per second with ORB-SLAM3 in the"
        " same turn. Images of 640x480 pixels are read and decoded within the time; systems take turns."
    )
    yield from part(text, speed_table(measurements), measurements, "system")
    if stages:
        text = (
            "Time of each stage, ms per frame. Stages run in parallel with those of the next frame, so that the sum"
            " can exceed the time of a frame. `motion` is the odometry, `bundle` local bundle"
            " adjustment. `v3d-torch run --profile` prints such a table for any run."
        )
        yield from part(text, pivot(rows_of(stages), "stage", "sequence", "ms"), stages)


def growth_section(measurements: Sequence[Measurement], keyframes: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on long runs and large maps."""
    yield "## Growth"
    if measurements:
        text = (
            "A sequence is played forwards and backwards. Time per frame and number of keyframes should stay constant,"
            " because the camera observes the same room. CPU ms per frame is given for each tenth of the run."
        )
        yield from part(text, flat(rows_of(measurements), columns.GROWTH), measurements, "frames")
    if keyframes:
        text = (
            "Place recognition and pose graph alone, on synthetic keyframes: a query of the keyframe database, and a"
            " loop over all keyframes. Both times should grow slowly with the number of keyframes."
        )
        yield from part(text, flat(rows_of(keyframes), columns.KEYFRAMES), keyframes)


def lost_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on interruptions."""
    yield "## Recovery of a lost camera"
    text = (
        "The camera is covered, frames are dropped, or the camera is moved elsewhere and back. A case passes if the"
        " camera is recovered within 10 frames at a known place, no covered frame is tracked, the ATE is at most 1.5"
        " times that of the uninterrupted run, and no pose reported as reliable is wrong by more than 0.1 m."
    )
    yield from part(text, flat(rows_of(measurements), columns.LOST), measurements, "sequence")


def calibration_section(measurements: Sequence[Measurement], held_out: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on calibration."""
    yield "## Calibration"
    text = (
        "`v3d-torch calibrate --segmenter none` estimates the camera from the images, starting with a deliberately"
        " wrong camera file. An estimate is accepted if the recording determines it within its tolerance, and if it"
        " differs significantly from the given value. The right values of a recording are those of its data set, which"
        " can differ by some pixels from the truth."
    )
    yield from part(text, flat(rows_of(measurements), columns.CALIBRATION), measurements, "sequence")
    if held_out:
        text = (
            "The camera is calibrated on the first half of the frames. ATE RMSE of the second half, which was not used,"
            " without masks: median and range over the seeds."
        )
        yield from part(text, flat(rows_of(held_out), columns.HELD_OUT), held_out, "sequence")


def plausibility_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on the plausibility check."""
    yield "## Plausibility of camera and depth"
    text = (
        "The camera file, the depth images or the colour images of each sequence are changed, and its first frames are"
        " run. The check should find the change, and nothing in the original sequence. A camera that stands still"
        " determines neither its focal length nor a delay of depth. The published depth of 7-Scenes (walkers_room,"
        " walkers_crowd) seems to be shifted by about (28, 3) pixels; this is not significant in so few views, but it"
        " hides a delay."
    )
    table = pivot(rows_of(measurements), "change", "sequence", "result")
    yield from part(text, table, measurements, "sequence")


def consistency_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on the covariance of poses."""
    yield "## Covariance of poses"
    text = (
        "Normalised estimation error squared (NEES) of the poses at each frame, without later corrections. Below its"
        " expectation, the covariance is too large; above it, too small. World, mounting on the camera and clock of the"
        " ground truth are calibrated, 13 numbers for all poses, which takes away errors that all poses share, such as"
        " that of the first camera. The noise of a motion capture system that is faster"
        " than the camera is measured from its poses and added to the covariance; its slower errors are not known. Of"
        " the composed sequences, walkers_desk has the motion capture of fr1_rpy, at the times of the frames only, and"
        " crowd_rpy the exact poses of a virtual camera. The bounds of the mean account for the autocorrelation of the"
        " errors."
    )
    yield from part(text, flat(rows_of(measurements), columns.CONSISTENCY), measurements, "sequence")


def objects_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on masks and ids of objects."""
    yield "## Objects: masks and ids"
    text = (
        "Moving masked: fraction of the true moving pixels with depth that tracking does not use, higher is"
        " better. Static masked: the same for static pixels, lower is better. ID switches: number of times that a"
        " person in view gets another ID, per 60 frames, lower is better. Each cell has the three values in this order."
    )
    rows = [
        cells | {"objects": f"{cells['moving_masked']} / {cells['static_masked']} / {cells['id_switches']}"}
        for cells in rows_of(measurements)
        if "moving_masked" in cells
    ]
    # The notes on these measurements are in the section on the ablation.
    yield from part(text, pivot(rows, "variant", "sequence", "objects", VARIANTS), measurements, remarks=())


def tracks_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on people's tracks beside other trackers."""
    yield "## Tracks of people"
    text = (
        "HOTA with its detection and association accuracy, IDF1 and MOTA by TrackEval, on masks: higher is better. ID"
        " switches in 60 frames in which a person is in view, lower is better. People's pixels in the right track:"
        " fraction of the true pixels of people that lie in the one track of this person. ByteTrack, OC-SORT and"
        " BoT-SORT are those of the package `trackers`, with the same detections; the better of two settings is shown."
        " The best HOTA and IDF1 of a sequence are bold."
    )
    yield from part(text, tracks_table(rows_of(measurements)), measurements, "sequence")


def tracks_table(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the table of tracks, a line per sequence and tracker, with the highest values of a sequence in bold."""
    marked = []
    for sequence in unique(cells["sequence"] for cells in rows):
        of_sequence = [cells for cells in rows if cells["sequence"] == sequence]
        bold = {name: mark_highest([cells[name] for cells in of_sequence]) for name in ("hota", "idf1")}
        marked += [
            cells | {"hota": hota, "idf1": idf1}
            for cells, hota, idf1 in zip(of_sequence, bold["hota"], bold["idf1"], strict=True)
        ]
    yield from flat(marked, columns.TRACKS)


def ablation_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on the effect of each part of the system."""
    yield "## Ablation"
    text = (
        "ATE RMSE in metres without each part of the system, lower is better. Many differences are smaller than the"
        " range over the seeds. [ablate](commands/ablate.md) describes the variants."
    )
    yield from part(text, pivot(rows_of(measurements), "variant", "sequence", "ate", VARIANTS), measurements)


def segmentation_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on segmentation networks."""
    yield "## Segmentation networks"
    text = (
        "People's pixels found: relative to the pixels that the network with 32 bits at 640x480 finds on the same"
        " frames. The columns after it score the whole system as in the section on objects. ms: time of one core per"
        " frame. If the network runs on every second or third frame, objects are predicted in between."
    )
    yield from part(text, network_tables(rows_of(measurements)), measurements)


def network_tables(rows: Sequence[Row]) -> Iterator[str]:
    """Yield a table of segmentation networks per sequence, each under a heading."""
    for number, sequence in enumerate(unique(cells["sequence"] for cells in rows)):
        if number:
            yield ""
        yield f"### {sequence} ({kind(sequence)})"
        yield ""
        yield from flat([cells for cells in rows if cells["sequence"] == sequence], columns.SEGMENTATION)


def maps_section(measurements: Sequence[Measurement], costs: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on dense maps."""
    yield "## Maps"
    if measurements:
        text = (
            "Points of the coloured map that belong to people, by the true masks, without and with the free-space"
            ' check; fewer are better. The check also removes some static points ("static points lost").'
        )
        yield from part(text, flat(rows_of(measurements), columns.MAPS), measurements, "sequence")
    if costs:
        text = "CPU time and size of the map, the mesh and the map file."
        yield from part(text, flat(rows_of(costs), columns.MAP_COSTS), costs, "sequence")


def occupancy_section(measurements: Sequence[Measurement], costs: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on the occupancy map."""
    yield "## Occupancy map"
    if measurements:
        text = (
            "The map of the demo, with estimated poses and masks, compared with the exact surfaces of the room. A voxel"
            " contains a surface even if the surface only touches a corner of it and is hardly visible; a sample"
            " represents 64 pixels. Unknown space is excluded from all rows."
        )
        yield from part(text, flat(rows_of(measurements), columns.OCCUPANCY), measurements)
    if costs:
        text = (
            "Time of the stage in the system, and of OctoMap (octomap-python) for the insertion of the same views;"
            " memory of voxels and stored views; size of the files; time of queries."
        )
        yield from part(text, flat(rows_of(costs), columns.OCCUPANCY_COSTS), costs, "sequence")


def primitives_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on the primitives of the object stage."""
    yield "## Primitives of the object stage"
    text = "Median time; ratio: time of the implementation divided by ours in the same turn, above 1 if ours is faster."
    yield from part(text, flat(rows_of(measurements), columns.PRIMITIVES), measurements)


def modules_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on the camera modules."""
    yield "## Camera modules"
    text = (
        "Median time of a batch with one thread; ratio: time of the implementation divided by ours in the same turn,"
        " above 1 if ours is faster. Implementations without batches solve the problems one after the other; factor"
        " graphs of GTSAM and theseus are built beforehand, outside of the time. Errors are medians over the batch: of"
        " poses, millimetres and milliradians in one number; of essential matrices, thousandths of their norm; of"
        " matches, the percentage that is missing; of gradients, the difference to ours, %; of `umeyama`, the"
        " difference to evo, thousandths."
    )
    yield from part(text, flat(rows_of(measurements), columns.MODULES), measurements)


def design_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on single measurements behind design choices."""
    yield "## Design choices"
    text = (
        "Single measurements that led to a choice. Each compares the choice with its alternative at one commit; no"
        " script repeats them. If the commit of the measurement is not known, the commit that recorded it is given."
    )
    rows = [
        cells | {"commit": f"{measurement.heading.commit}, {measurement.heading.date}"}
        for measurement in measurements
        for cells in measurement.rows
    ]
    yield from part(text, flat(rows, columns.DESIGN_CHOICES))


SECTIONS: Sequence[tuple[tuple[str, ...], Callable[..., Iterator[str]]]] = (
    (("accuracy",), accuracy_section),
    (("speed", "stages"), speed_section),
    (("growth", "keyframes"), growth_section),
    (("lost",), lost_section),
    (("calibration", "held_out"), calibration_section),
    (("plausibility",), plausibility_section),
    (("consistency",), consistency_section),
    (("ablation",), objects_section),
    (("tracks",), tracks_section),
    (("segmentation",), segmentation_section),
    (("maps", "map_costs"), maps_section),
    (("occupancy", "occupancy_costs"), occupancy_section),
    (("ablation",), ablation_section),
    (("primitives",), primitives_section),
    (("modules",), modules_section),
    (("design_choices",), design_section),
)
"""Files of each section in ``benchmarks/results``, and the function that writes it."""
