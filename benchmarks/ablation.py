"""Ablation study of the system: accuracy, masks and object ids without each of its parts, as Markdown.

``python benchmarks/ablation.py --seqs crowd_rpy walkers_desk`` runs ``python -m v3d_torch ablate`` and tabulates all
sequences beside each other.
"""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from command import make_parser, publish
from heading import make_heading
from sequences import locate_sequence
from storage import Measurement, Row, file_of

from v3d_torch.evaluation.ablation import VARIANTS
from v3d_torch.evaluation.tables import format_median_and_range, markdown_row

CELLS = {
    "ate": ("ate.rmse", ".4f"),
    "moving_masked": ("masks.moving_masked", ".1%"),
    "static_masked": ("masks.static_masked", ".1%"),
    "id_switches": ("masks.id_switches_per_60_frames", ".2f"),
}
"""Column of ``ablation.csv`` and format of each cell."""


def summarise(runs: Sequence[Row]) -> Iterator[Row]:
    """Yield a row per sequence and variant: median and range of each metric over the seeds."""
    for sequence, variant in dict.fromkeys((run["sequence"], run["variant"]) for run in runs):
        matching = [run for run in runs if (run["sequence"], run["variant"]) == (sequence, variant)]
        cells = {"sequence": sequence, "variant": variant}
        for name, (column, form) in CELLS.items():
            cells[name] = format_median_and_range([float(run[column]) for run in matching if run[column]], form)
        yield cells


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Yield a line per sequence and variant."""
    yield markdown_row(["sequence", "variant", "ATE, m", "moving masked", "static masked", "ID switches"])
    yield markdown_row(["---", "---"] + ["---:"] * len(CELLS))
    yield from (markdown_row([cells["sequence"], cells["variant"], *(cells[name] for name in CELLS)]) for cells in rows)


def main() -> None:
    """Run the study and print its table."""
    parser = make_parser("Ablation study of the system, as Markdown.")
    parser.add_argument("--seqs", nargs="+", required=True, help="sequences with ground truth")
    parser.add_argument("--variants", default=",".join(VARIANTS), help="variants, separated by commas [all]")
    parser.add_argument("--seeds", type=int, default=3, help="number of runs of each variant, with seeds from 0 [3]")
    options = parser.parse_args()
    heading = make_heading()
    sources = [word for name in options.seqs for word in ("--seq", locate_sequence(name, options.data_root))]
    with TemporaryDirectory() as out:
        # -P: the package imported here, whose commit is in the heading, not one in the working folder.
        command = [sys.executable, "-P", "-m", "v3d_torch", "ablate", *sources, "--variants", options.variants]
        done = subprocess.run([*command, "--seeds", str(options.seeds), "--out", out], stdout=sys.stderr)  # noqa: S603
        if not (Path(out) / "ablation.csv").is_file():
            parser.exit(done.returncode)
        with (Path(out) / "ablation.csv").open(newline="", encoding="utf-8") as file:
            rows = list(summarise(list(csv.DictReader(file))))
    publish([*heading.lines(), "", *table(rows)], options, parser, {file_of("ablation"): Measurement(heading, rows)})


if __name__ == "__main__":
    main()
