"""Latency, dropped frames and accuracy of live runs on stored sequences, as Markdown.

``python benchmarks/live.py --seqs fr1_rpy crowd_rpy walkers_desk`` plays each sequence at its own rate, as a camera
sends it, with ``v3d-torch run --config realtime --realtime``. The accuracy is compared with runs of the same
configuration that process every frame.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import columns
from accuracy import Outcome, ate_cell, run
from command import add_sequences_option, make_parser, publish
from heading import make_heading
from storage import Measurement, Row
from tables import flat

from v3d_torch.evaluation.tables import format_median_and_range


def measure(sequence: str, runs: int, data_root: Path) -> tuple[Row, list[Outcome]]:
    """Run a sequence live and offline, each with seeds from 0.

    Returns:
        Cells of the sequence, and the failed runs.
    """
    live: list[Outcome] = []
    offline: list[Outcome] = []
    for seed in range(runs):
        for configuration, outcomes in (("live", live), ("realtime", offline)):
            outcomes.append(run(sequence, configuration, seed, data_root))
            print(outcomes[-1], file=sys.stderr)
    cells = {"sequence": sequence, **dict(live_cells(live)), "ate": ate_cell(live), "offline": ate_cell(offline)}
    return cells, [outcome for outcome in (*live, *offline) if outcome.metrics is None]


def live_cells(outcomes: Sequence[Outcome]) -> Iterator[tuple[str, str]]:
    """Yield the cells of latencies, milliseconds, and dropped frames: median and range over the runs."""
    metrics = [outcome.metrics for outcome in outcomes if outcome.metrics is not None]
    yield "frames", str(metrics[0]["frames"]) if metrics else "-"
    for name in ("pose_latency", "latency"):
        for statistic in ("median", "p95"):
            values = [1e3 * each[name][statistic] for each in metrics]
            yield f"{name}_{statistic}", format_median_and_range(values, ".0f")
    yield "dropped", format_median_and_range([each["dropped"] / each["frames"] for each in metrics], ".0%")


def main() -> None:
    """Run all sequences and print the table."""
    parser = make_parser("Latency, dropped frames and accuracy of live runs, as Markdown.")
    add_sequences_option(parser, "colour, depth and ground truth")
    parser.add_argument("--runs", type=int, default=3, help="number of live runs of each sequence [3]")
    options = parser.parse_args()
    if options.runs < 1:
        parser.error("give at least --runs 1")
    heading = make_heading()
    rows: list[Row] = []
    failures: list[str] = []
    for sequence in options.seqs:
        cells, failed = measure(sequence, options.runs, options.data_root)
        rows.append(cells)
        failures += [f"- {outcome}" for outcome in failed]
    lines = [*heading.lines(), "", *flat(rows, columns.LIVE), *([""] if failures else []), *failures]
    publish(lines, options, parser, {"live": Measurement(heading, rows)})


if __name__ == "__main__":
    main()
