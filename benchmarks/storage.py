"""Measurements as JSON files in ``benchmarks/results``, from which `write_page` makes the documentation.

A file holds measurements, each with a heading, rows and notes. A row maps the names of its cells to their text, as the
benchmark prints them. Two rows of a file with the same keys (`KEYS`) are the same quantity: the newer one replaces the
older one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from heading import Heading

from v3d_torch.io.files import write_text
from v3d_torch.segmentation.quantise import has_int8_instructions

RESULTS = Path(__file__).with_name("results")

KEYS: Mapping[str, tuple[str, ...]] = {
    "ablation": ("sequence", "variant"),
    "ablation_float32": ("sequence", "variant"),
    "accuracy": ("sequence", "system"),
    "calibration": ("sequence", "change", "parameter"),
    "consistency": ("sequence", "configuration"),
    "degraded": ("sequence", "degradation"),
    "design_choices": ("choice", "sequence"),
    "feature_uncertainty": ("sequence",),
    "growth": ("sequence", "frames"),
    "held_out": ("sequence", "change"),
    "keyframes": ("keyframes",),
    "live": ("sequence",),
    "lost": ("sequence", "interruption"),
    "map_costs": ("sequence",),
    "maps": ("sequence", "pixels"),
    "modules": ("function", "batch", "implementation"),
    "occupancy": ("quantity",),
    "occupancy_costs": ("sequence",),
    "plausibility": ("sequence", "change"),
    "primitives": ("primitive", "size", "threads", "implementation"),
    "segmentation": ("sequence", "network"),
    "speed": ("sequence", "system"),
    "speed_float32": ("sequence", "system"),
    "stages": ("sequence", "stage"),
    "stages_float32": ("sequence", "stage"),
    "tracks": ("sequence", "tracker"),
    "tracks_float32": ("sequence", "tracker"),
    "voting_thresholds": ("sequence", "rule", "numbers"),
}
"""Cells that identify a row, by the name of the file."""

Row = dict[str, str]


@dataclass(frozen=True)
class Measurement:
    """Rows measured by one command.

    Attributes:
        heading: Command, commit, date and hardware.
        rows: Cells by their names.
        notes: Sentences on these rows, for the page.
    """

    heading: Heading
    rows: Sequence[Row]
    notes: Sequence[str] = ()


def file_of(name: str) -> str:
    """Return the file of a measurement: processors without 8-bit vector instructions have files of their own."""
    return name if has_int8_instructions() else f"{name}_float32"


def load(name: str, folder: Path = RESULTS) -> list[Measurement]:
    """Load the measurements of a benchmark, oldest first; an empty list if there is no file."""
    path = folder / f"{name}.json"
    if not path.is_file():
        return []
    stored = json.loads(path.read_text(encoding="utf-8"))
    return [Measurement(Heading(**entry["heading"]), entry["rows"], entry["notes"]) for entry in stored]


def save(name: str, measurement: Measurement, folder: Path = RESULTS) -> None:
    """Add a measurement to the file of a benchmark, and remove older rows with the same keys.

    The notes of a measurement that loses rows are removed, because they may describe these rows.

    Raises:
        OutputError: If the file cannot be written.
    """
    measured = {key_of(name, row) for row in measurement.rows}
    kept = []
    for older in load(name, folder):
        rows = [row for row in older.rows if key_of(name, row) not in measured]
        if rows:
            kept.append(Measurement(older.heading, rows, older.notes if len(rows) == len(older.rows) else ()))
    folder.mkdir(exist_ok=True)
    entries = [asdict(entry) for entry in [*kept, measurement]]
    write_text(folder / f"{name}.json", json.dumps(entries, indent=1, ensure_ascii=False) + "\n")


def key_of(name: str, row: Row) -> tuple[str, ...]:
    """Return the cells that identify a row."""
    return tuple(row[key] for key in KEYS[name])
