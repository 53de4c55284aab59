"""Markdown tables of stored measurements, and lines with their provenance."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TypeVar

import columns
from descriptions import describe, kind, published
from storage import Measurement, Row

from v3d_torch.evaluation.tables import markdown_row

T = TypeVar("T")

SYSTEMS = {
    "full": "full",
    "realtime": "realtime",
    "baseline": "baseline",
    "pyorbslam3": "ORB-SLAM3 (PyPI)",
    "open3d": "Open3D odometry",
}
"""Names of systems in tables; other systems keep their own names."""

COMMANDS = {
    "v3d_torch": "v3d_torch",
    "v3d_torch --config realtime": "v3d_torch `--config realtime`",
    "v3d_torch --serial": "v3d_torch `--serial`",
    "v3d_torch --segmenter none": "v3d_torch `--segmenter none`",
    "open3d": "Open3D odometry (no segmentation)",
    "pyorbslam3": "ORB-SLAM3 (PyPI; no segmentation)",
}
"""Names of systems in tables, in the order of their rows."""


VARIANTS = {
    "baseline": "no masks",
    "no_voting": "no votes",
    "no_free_space": "no free-space check",
    "no_chamfer": "no Chamfer distance",
    "no_prediction": "no prediction of missed objects",
    "no_appearance": "no colours in the assignment of ids",
    "no_unlabelled": "no unlabelled instances",
    "not_upright": "images not rotated upright",
    "global_shutter": "no model of the rolling shutter",
    "paper": "the paper's rules for votes, Chamfer distances and motion states",
    "full": "full",
}
"""Names of the variants of the ablation study in tables."""

DESIGN_TOPICS = (
    "Segmentation network",
    "Masks",
    "Ids",
    "Motion of objects",
    "Positions and velocities of objects",
    "Tracking and mapping",
    "Camera model: rolling shutter, depth delay, calibration",
    "Dense map and occupancy map",
    "Preset realtime and live",
    "Speed and memory",
    "Sequences on which no parameter was chosen",
)
"""Topics of the design choices, in the order of their tables."""


def accuracy_table(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield a line per sequence: ATE of each system that ran, then of those in ``peers.yaml``."""
    rows = rows_of(measurements)
    systems = [system for system in SYSTEMS if any(cells["system"] == system for cells in rows)]
    systems += [system for system in unique(cells["system"] for cells in rows) if system not in SYSTEMS]
    sequences = unique(cells["sequence"] for cells in rows)
    peers = unique(peer for sequence in sequences for peer in published(sequence))
    yield markdown_row(["sequence", "frames", *(SYSTEMS.get(system, system) for system in systems), *peers])
    yield markdown_row(["---", *["---:"] * (1 + len(systems) + len(peers))])
    for sequence in sequences:
        measured = {cells["system"]: cells for cells in rows if cells["sequence"] == sequence}
        texts = [accuracy_cell(measured[system]) if system in measured else "-" for system in systems]
        texts += [published(sequence).get(peer, "-") for peer in peers]
        frames = next((cells["frames"] for cells in measured.values() if "frames" in cells), "-")
        yield markdown_row([describe(sequence), frames, *mark_lowest(texts)])


def accuracy_cell(cells: Row) -> str:
    """Return the ATE of a system, with its coverage if that is below 100%."""
    return f"{cells['ate']} ({cells['poses']})" if "poses" in cells else cells["ate"]


def speed_table(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield a line per system: speed on each sequence, then its ratio to ORB-SLAM3."""
    rows = {(cells["system"], cells["sequence"]): cells for cells in rows_of(measurements)}
    sequences = unique(sequence for _, sequence in rows)
    frames = {sequence: cells["frames"] for (_, sequence), cells in rows.items() if cells["frames"] != "-"}
    headings = [f"{sequence} ({kind(sequence)}), {frames.get(sequence, '-')} frames" for sequence in sequences]
    ratios = [f"relative to ORB-SLAM3, {sequence}" for sequence in sequences]
    yield markdown_row(["frames per second (CPU ms per frame)", *headings, *ratios])
    yield markdown_row(["---", *["---:"] * (2 * len(sequences))])
    for system in sorted({system for system, _ in rows}, key=list(COMMANDS).index):  # an unknown system is an error
        measured = [rows.get((system, sequence)) for sequence in sequences]
        speeds = [f"{cells['fps']} ({cells['cpu_ms']})" if cells else "-" for cells in measured]
        yield markdown_row([COMMANDS[system], *speeds, *(cells["fps_ratio"] if cells else "-" for cells in measured)])


def objects_table(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the table of masks and ids: a line per variant, a column per sequence, three values in a cell."""
    rows = [
        cells | {"objects": f"{cells['moving_masked']} / {cells['static_masked']} / {cells['id_switches']}"}
        for cells in rows_of(measurements)
        if "moving_masked" in cells
    ]
    yield from pivot(rows, "variant", "sequence", "objects", VARIANTS)


def tracks_table(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the table of tracks, a line per sequence and tracker, with the highest values of a sequence in bold."""
    rows, marked = rows_of(measurements), []
    for sequence in unique(cells["sequence"] for cells in rows):
        of_sequence = [cells for cells in rows if cells["sequence"] == sequence]
        bold = {name: mark_highest([cells[name] for cells in of_sequence]) for name in ("hota", "idf1")}
        marked += [
            cells | {"hota": hota, "idf1": idf1}
            for cells, hota, idf1 in zip(of_sequence, bold["hota"], bold["idf1"], strict=True)
        ]
    yield from flat(marked, columns.TRACKS)


def network_tables(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield a table of segmentation networks per sequence, each under a heading."""
    rows = rows_of(measurements)
    tables = {
        f"{sequence} ({kind(sequence)})": [cells for cells in rows if cells["sequence"] == sequence]
        for sequence in unique(cells["sequence"] for cells in rows)
    }
    yield from _tables_with_headings(tables, columns.SEGMENTATION)


def design_tables(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield a table of design choices per topic, each under a heading: a line per measurement, with commit and date."""
    tables: dict[str, list[Row]] = {topic: [] for topic in DESIGN_TOPICS}
    for measurement in measurements:
        for cells in measurement.rows:  # an unknown topic is an error
            commit = f"{measurement.heading.commit}, {measurement.heading.date}"
            tables[cells["topic"]].append(cells | {"commit": commit})
    yield from _tables_with_headings({topic: rows for topic, rows in tables.items() if rows}, columns.DESIGN_CHOICES)


def _tables_with_headings(tables: Mapping[str, Sequence[Row]], names: Mapping[str, str]) -> Iterator[str]:
    """Yield tables with the same columns, each under its heading."""
    for number, (heading, rows) in enumerate(tables.items()):
        if number:
            yield ""
        yield f"### {heading}"
        yield ""
        yield from flat(rows, names)


def pivot(
    rows: Sequence[Row], index: str, column: str, value: str, names: Mapping[str, str] | None = None
) -> Iterator[str]:
    """Yield a table with a line per value of one cell and a column per value of another one.

    Args:
        rows: Rows to tabulate.
        index: Cell whose values are the lines.
        column: Cell whose values are the columns; sequences get their kind in the heading.
        value: Cell in the table.
        names: Names of the lines.
    """
    cells = {(cells[index], cells[column]): cells[value] for cells in rows}
    keys = unique(key for _, key in cells)
    headings = [f"{key} ({kind(key)})" if column == "sequence" else key for key in keys]
    yield markdown_row([index, *headings])
    yield markdown_row(["---", *["---:"] * len(keys)])
    for line in unique(key for key, _ in cells):
        yield markdown_row([(names or {}).get(line, line), *(cells.get((line, key), "-") for key in keys)])


def flat(rows: Sequence[Row], headings: Mapping[str, str]) -> Iterator[str]:
    """Yield a table with a line per row and the columns that at least one row has.

    Args:
        rows: Rows to tabulate.
        headings: Headings of the columns by cell.
    """
    shown = [name for name in headings if any(name in cells for cells in rows)]
    yield markdown_row([headings[name] for name in shown])
    yield markdown_row(["---"] * len(shown))
    for cells in rows:
        yield markdown_row([cells.get(name, "-") for name in shown])


def mark_lowest(texts: Sequence[str]) -> list[str]:
    """Return cells with the lowest leading number in bold, as often as it is shown."""
    return _mark(texts, min)


def mark_highest(texts: Sequence[str]) -> list[str]:
    """Return cells with the highest leading number in bold, as often as it is shown."""
    return _mark(texts, max)


def _mark(texts: Sequence[str], select: Callable[[Iterable[float]], float]) -> list[str]:
    """Return cells with the selected leading number in bold."""
    numbers = [float(match[0]) if (match := re.match(r"[\d.]+", text)) else None for text in texts]
    known = [number for number in numbers if number is not None]
    marked = select(known) if known else None
    return [
        re.sub(r"^[\d.]+", lambda match: f"**{match[0]}**", text) if number is not None and number == marked else text
        for text, number in zip(texts, numbers, strict=True)
    ]


def rows_of(measurements: Iterable[Measurement]) -> list[Row]:
    """Return all rows."""
    return [cells for measurement in measurements for cells in measurement.rows]


def notes(measurements: Iterable[Measurement]) -> list[str]:
    """Return all notes."""
    return [note for measurement in measurements for note in measurement.notes]


def commits(measurements: Iterable[Measurement]) -> list[str]:
    """Return the distinct commits."""
    return unique(measurement.heading.commit for measurement in measurements)


def bullets(texts: Iterable[str]) -> Iterator[str]:
    """Yield a list item per text."""
    yield from (f"- {text}" for text in texts)


def provenance(measurements: Sequence[Measurement], key: str | None = None) -> Iterator[str]:
    """Yield a line per measurement: command, commit, date and hardware.

    Args:
        measurements: Measurements of a table.
        key: Cell that distinguishes the rows of several measurements.
    """
    for measurement in measurements:
        heading = measurement.heading
        label = ""
        if key is not None and len(measurements) > 1:
            label = ", ".join(unique(SYSTEMS.get(cells[key], cells[key]) for cells in measurement.rows)) + ": "
        hardware = f"hardware {heading.hardware}" if heading.hardware == "not recorded" else heading.hardware
        command = [f"`{heading.command}`"] if heading.command else []
        details = [f"commit {heading.commit}", heading.date, hardware, heading.versions]
        yield f"- {label}" + "; ".join([*command, *filter(None, details)])


def unique(items: Iterable[T]) -> list[T]:
    """Return the distinct items in the order of their first occurrence."""
    return list(dict.fromkeys(items))
