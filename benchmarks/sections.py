"""Sections of ``docs/benchmarks.md``, each made of the measurements of one or two benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from descriptions import PEERS, kind, sequence_notes
from storage import Measurement
from tables import accuracy_table, bullets, flat, notes, pivot, provenance, rows_of, speed_table, unique

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


def accuracy_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on accuracy."""
    yield "## Accuracy"
    yield ""
    yield (
        "ATE RMSE in metres, lower is better; the lowest value of a row is bold. `full` is the default"
        " configuration, `baseline` is `--segmenter none`. ORB-SLAM3 (PyPI) is pyorbslam3 with a vocabulary trained"
        " on the sequences; it is not deterministic. A system that leaves out hard frames has a lower error, so"
        " coverage is given if it is below 100%."
    )
    yield ""
    yield from accuracy_table(measurements)
    yield ""
    yield from provenance(measurements, "system")
    yield f"- ORB-SLAM2, ORB-SLAM3, NGD-SLAM: {PEERS['about']}"
    yield from bullets(notes(measurements))
    yield from (f"- {name}: {note}" for note, name in sequence_notes())


def speed_section(measurements: Sequence[Measurement], stages: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on speed."""
    yield "## Speed"
    yield ""
    yield (
        "Frames per second, higher is better, and in parentheses CPU ms per frame: user and system time of all"
        " threads and processes, lower is better. The last columns compare frames per second with ORB-SLAM3 in the"
        " same turn. Images of 640x480 pixels are read and decoded within the time; contenders take turns."
    )
    yield ""
    yield from speed_table(measurements)
    yield ""
    yield from provenance(measurements, "contender")
    yield from bullets(notes(measurements))
    if stages:
        yield ""
        yield (
            "Time of each stage, ms per frame. Stages run in parallel with those of the next frame, so that the sum"
            " can exceed the time of a frame. `motion` is the odometry, `bundle` local bundle"
            " adjustment. `v3d-torch run --profile` prints such a table for any run."
        )
        yield ""
        yield from pivot(rows_of(stages), "stage", "sequence", "ms")
        yield ""
        yield from provenance(stages)


def growth_section(measurements: Sequence[Measurement], keyframes: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on long runs and large maps."""
    yield "## Growth"
    yield ""
    if measurements:
        yield (
            "A sequence is played forth and back. Time per frame and number of keyframes should stay constant,"
            " because the camera observes the same room. CPU ms per frame is given for each tenth of the run."
        )
        yield ""
        columns = {
            "sequence": "sequence",
            "frames": "frames",
            "cpu_ms": "CPU ms per frame",
            "memory_mb": "memory, MB",
            "memory_kb_per_frame": "growth, kB per frame",
            "keyframes": "keyframes",
            "loops": "loops",
        }
        yield from flat(rows_of(measurements), columns)
        yield ""
        yield from provenance(measurements, "frames")
        yield from bullets(notes(measurements))
    if keyframes:
        yield ""
        yield (
            "Place recognition and pose graph alone, on synthetic keyframes: a query of the keyframe database, and a"
            " loop over all keyframes. Both times should grow slowly with the number of keyframes."
        )
        yield ""
        columns = {"keyframes": "keyframes", "add_ms": "add one, ms", "query_ms": "query, ms"}
        columns |= {"pose_graph_s": "pose graph, s", "error_before": "error before, m", "error_after": "error after, m"}
        yield from flat(rows_of(keyframes), columns)
        yield ""
        yield from provenance(keyframes)


def lost_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on interruptions."""
    yield "## Lost and found"
    yield ""
    yield (
        "The camera is covered, frames are dropped, or the camera is moved elsewhere and back. A case passes if the"
        " camera is recovered within 10 frames at a known place, no covered frame is tracked, the ATE is at most 1.5"
        " times that of the uninterrupted run, and no pose reported as reliable is wrong by more than 0.1 m."
    )
    yield ""
    columns = {
        "sequence": "sequence",
        "interruption": "interruption",
        "recovery": "frames to recover",
        "unflagged": "covered but tracked",
        "found": "reliable poses",
        "ate": "ATE, m",
        "ratio": "relative to uninterrupted",
        "worst": "worst error, m",
        "reference_worst": "uninterrupted, m",
        "passes": "passes",
    }
    yield from flat(rows_of(measurements), columns)
    yield ""
    yield from provenance(measurements, "sequence")
    yield from bullets(notes(measurements))


def objects_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on masks and ids of objects."""
    yield "## Objects: masks and ids"
    yield ""
    yield (
        "Moving masked: fraction of the true moving pixels with depth that tracking does not use, higher is"
        " better. Static masked: the same for static pixels, lower is better. ID switches: how often a person in"
        " view gets another ID in 60 frames, lower is better. Each cell has the three values in this order."
    )
    yield ""
    rows = [
        cells | {"objects": f"{cells['moving_masked']} / {cells['static_masked']} / {cells['id_switches']}"}
        for cells in rows_of(measurements)
        if "moving_masked" in cells
    ]
    yield from pivot(rows, "variant", "sequence", "objects", VARIANTS)
    yield ""
    yield from provenance(measurements)


def ablation_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on the effect of each part of the system."""
    yield "## Ablation"
    yield ""
    yield (
        "ATE RMSE in metres without each part of the system, lower is better. Many differences are smaller than the"
        " range over the seeds. [ablate](commands/ablate.md) describes the variants."
    )
    yield ""
    yield from pivot(rows_of(measurements), "variant", "sequence", "ate", VARIANTS)
    yield ""
    yield from provenance(measurements)
    yield from bullets(notes(measurements))


def segmentation_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on segmentation networks."""
    yield "## Segmentation networks"
    yield ""
    yield (
        "People's pixels found: fraction of those that the network with 32 bits at 640x480 finds on the same frames."
        " The columns after it score the whole system as in the section on objects. ms: time of one core per frame."
        " If the network runs on every second or third frame, objects are predicted in between."
    )
    rows = rows_of(measurements)
    columns = {
        "network": "network",
        "ms": "ms",
        "people_found": "people's pixels found",
        "moving_masked": "moving masked",
        "static_masked": "static masked",
        "id_switches": "ID switches",
        "ate": "ATE, m",
    }
    for sequence in unique(cells["sequence"] for cells in rows):
        yield ""
        yield f"### {sequence} ({kind(sequence)})"
        yield ""
        yield from flat([cells for cells in rows if cells["sequence"] == sequence], columns)
    yield ""
    yield from provenance(measurements)
    yield from bullets(notes(measurements))


def maps_section(measurements: Sequence[Measurement], costs: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on dense maps."""
    yield "## Maps"
    yield ""
    if measurements:
        yield (
            "Points of the coloured map that belong to people, by the true masks, without and with the free-space"
            " check; fewer are better. Static points lost is the price of the check."
        )
        yield ""
        columns = {
            "sequence": "sequence",
            "pixels": "pixels in the map",
            "points_before": "points",
            "people_before": "people",
            "points_after": "points with check",
            "people_after": "people with check",
            "static_lost": "static points lost",
        }
        yield from flat(rows_of(measurements), columns)
        yield ""
        yield from provenance(measurements, "sequence")
    if costs:
        yield ""
        yield "CPU time and size of the map, the mesh and the map file."
        yield ""
        columns = {"sequence": "sequence", "keyframes": "keyframes", "points": "points", "triangles": "triangles"}
        yield from flat(rows_of(costs), columns | {"saving": "saving", "loading": "loading"})
        yield ""
        yield from provenance(costs, "sequence")


def primitives_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on the primitives of the object stage."""
    yield "## Primitives of the object stage"
    yield ""
    yield "Median time; the ratio is the time of the competitor over ours in the same turn: above 1 ours is faster."
    yield ""
    columns = {"primitive": "primitive", "size": "size", "threads": "threads", "competitor": "competitor"}
    yield from flat(rows_of(measurements), columns | {"ms": "ms", "ratio": "ratio"})
    yield ""
    yield from provenance(measurements)


def design_section(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the section on single measurements behind design choices."""
    yield "## Design choices"
    yield ""
    yield (
        "Single measurements that led to a choice. Each compares the choice with its alternative at one commit; no"
        " script repeats them. If the commit of the measurement is not known, the commit that recorded it is given."
    )
    yield ""
    rows = [
        cells | {"commit": f"{measurement.heading.commit}, {measurement.heading.date}"}
        for measurement in measurements
        for cells in measurement.rows
    ]
    yield from flat(rows, {"choice": "choice", "sequence": "sequence", "result": "result", "commit": "commit"})


SECTIONS: Sequence[tuple[tuple[str, ...], Callable[..., Iterator[str]]]] = (
    (("accuracy",), accuracy_section),
    (("speed", "stages"), speed_section),
    (("growth", "keyframes"), growth_section),
    (("lost",), lost_section),
    (("ablation",), objects_section),
    (("segmentation",), segmentation_section),
    (("maps", "map_costs"), maps_section),
    (("ablation",), ablation_section),
    (("primitives",), primitives_section),
    (("design_choices",), design_section),
)
"""Files of each section in ``benchmarks/results``, and the function that writes it."""
