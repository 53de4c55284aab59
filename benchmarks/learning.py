"""What learnt parameters give on sequences that were not used to learn them, as Markdown.

``python benchmarks/learning.py uncertainty --train demo --test demo:things`` runs the notebook
``learn_feature_uncertainty`` with these sequences; ``thresholds`` runs ``learn_voting_thresholds``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import columns
from command import make_parser, publish
from heading import make_heading
from notebook_runs import run_notebook
from sequences import locate_sequence
from storage import Measurement, Row
from tables import flat

from v3d_torch.datasets import load_sequence
from v3d_torch.errors import V3DError
from v3d_torch.evaluation.tables import format_median_and_range

_PAIR_STEP = 3
"""Step between the first frames of two training pairs, frames: their images still differ."""


def uncertainty(options: argparse.Namespace) -> Iterator[Row]:
    """Yield the ATE with equal and with learnt uncertainties for each sequence."""
    settings = {
        "TRAIN": _parts(options.train, options, step=_PAIR_STEP),
        "TEST": _parts(options.test, options),
        "STEPS": 250,
        "SEEDS": options.seeds,
    }
    rows = run_notebook("learn_feature_uncertainty", settings)["rows"]
    for source, frames in settings["TEST"]:
        own = [row for row in rows if row["sequence"] == source]
        yield {
            "sequence": Path(source).name,
            "train": ", ".join(options.train),
            "frames": str(len(frames)),
            **{name: format_median_and_range([row[name] for row in own], ".4f") for name in ("default", "learnt")},
            "ratios": " ".join(f"{row['learnt'] / row['default']:.2f}" for row in own),
        }


def thresholds(options: argparse.Namespace) -> Iterator[Row]:
    """Yield precision, recall and F1 with the default and with the learnt thresholds for each sequence and rule."""
    settings = {
        "TRAIN": _parts(options.train, options),
        "TEST": _parts(options.test, options),
        "STEPS": 150,
        "CANDIDATES": (1, 2, 3),
        "USE_NETWORK": True,
    }
    found = run_notebook("learn_voting_thresholds", settings)
    for row in found["rows"]:
        numbers = found["learnt"] if row["numbers"] == "learnt" else vars(found["default"])
        yield {
            "sequence": Path(row["sequence"]).name,
            "train": ", ".join(options.train),
            "rule": row["rule"],
            "numbers": f"{row['numbers']}: {numbers['distance_threshold']:g} m, {numbers['vote_threshold']}",
            **{name: f"{row[name]:.3f}" for name in ("precision", "recall", "f1")},
        }


STUDIES = {
    "uncertainty": (uncertainty, "feature_uncertainty", columns.FEATURE_UNCERTAINTY),
    "thresholds": (thresholds, "voting_thresholds", columns.VOTING_THRESHOLDS),
}


def _parts(names: Sequence[str], options: argparse.Namespace, step: int = 1) -> list[tuple[str, Any]]:
    """Return the sequences as `load_sequence` takes them, with their frames."""
    sources = [locate_sequence(name, options.data_root) for name in names]
    return [(source, range(0, min(len(load_sequence(source)), options.frames), step)) for source in sources]


def main() -> None:
    """Run a study and print the table."""
    parser = make_parser("What learnt parameters give on other sequences, as Markdown.")
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--train", nargs="+", required=True, help="sequences to learn from")
    parser.add_argument("--test", nargs="+", required=True, help="other sequences")
    parser.add_argument("--frames", type=int, default=10**6, help="maximum number of frames of a sequence [all]")
    parser.add_argument("--seeds", type=int, default=3, help="networks that are trained and runs with each [3]")
    options = parser.parse_args()
    study, name, headings = STUDIES[options.study]
    heading = make_heading()
    try:
        rows = list(study(options))
    except V3DError as error:
        parser.error(str(error))
    publish([*heading.lines(), "", *flat(rows, headings)], options, parser, {name: Measurement(heading, rows)})


if __name__ == "__main__":
    main()
