"""Accuracy of the whole system on sequences in TUM layout, beside other systems, as Markdown.

``python benchmarks/accuracy.py`` runs ``python -m v3d_torch.run`` for each sequence, configuration and seed, one after
the other, so that no run slows another. A failed run is listed with its error message. ``--peers`` runs other systems
on the same frames. The figures of systems that are not run come from ``peers.yaml`` and, on the paper's sequences, from
its tables.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import descriptions
from command import add_vocabulary_option, make_parser, publish
from heading import make_heading
from sequences import list_sequences, locate_sequence, trained_vocabulary
from storage import Measurement, Row
from systems import PEERS
from systems.process import SystemRunError, failure, measure
from tables import unique

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.sequence_names import find_paper_sequence
from v3d_torch.errors import InputError, V3DError
from v3d_torch.evaluation import evaluate
from v3d_torch.evaluation.paper_tables import load_paper_scores
from v3d_torch.evaluation.tables import format_median_and_range, markdown_row
from v3d_torch.types import TrackingStatus

CONFIGURATIONS = {
    "full": [],
    "baseline": ["--segmenter", "none"],
    "global_shutter": ["--config", "global_shutter"],
    "paper": ["--config", "paper"],
    "realtime": ["--config", "realtime"],
    "live": ["--config", "realtime", "--realtime"],
}


PEER_RATE = 0.5
"""Speed at which ORB-SLAM3 gets the frames, relative to that of the recording, so that its mapping threads are not
late on a slow processor."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run.

    Attributes:
        sequence: Name of the sequence.
        configuration: Configuration or peer.
        seed: Seed of the run.
        metrics: Values of its ``metrics.json``; None if it failed.
        failure: Error message, if it failed.
    """

    sequence: str
    configuration: str
    seed: int
    metrics: dict[str, Any] | None
    failure: str = ""

    @property
    def ate(self) -> float | None:
        """ATE RMSE, metres; None if the run failed or has no score."""
        score = self.metrics.get("ate") if self.metrics else None
        return score["rmse"] if score else None

    def __str__(self) -> str:
        """Return a one-line description for the screen."""
        result = f"failed: {self.failure}"
        if self.metrics is not None:
            ate = (
                "no score (no ground truth, or too few matching poses)" if self.ate is None else f"ATE {self.ate:.4f} m"
            )
            result = f"{ate}, {self.metrics['fps']:.1f} frames per second"
        return f"{self.sequence}, {self.configuration}, seed {self.seed}: {result}"


def run(sequence: str, configuration: str, seed: int, data_root: Path) -> Outcome:
    """Run the system once in a new process with a temporary folder."""
    source = ["--seq", locate_sequence(sequence, data_root), "--data-root", str(data_root)]
    with TemporaryDirectory() as out:
        # -P: the package imported here, whose commit is in the heading, not one in the working folder.
        command = [sys.executable, "-P", "-m", "v3d_torch.run", *source, "--seed", str(seed), "--out", out]
        done = subprocess.run(command + CONFIGURATIONS[configuration], capture_output=True, text=True)  # noqa: S603
        if done.returncode:
            message = failure(done).replace(out, "its temporary folder")
            return Outcome(sequence, configuration, seed, None, message)
        metrics = json.loads((Path(out) / "metrics.json").read_text(encoding="utf-8"))
    return Outcome(sequence, configuration, seed, metrics)


def run_peer(sequence: str, peer: str, turn: int, data_root: Path, vocabulary: Path | None) -> Outcome:
    """Run another system once on the same frames and score it in the same way."""
    try:
        source = locate_sequence(sequence, data_root)
        measured = measure(peer, source, data_root, vocabulary=vocabulary, rate=PEER_RATE)
        truth = load_sequence(source, data_root=data_root).groundtruth
    except (SystemRunError, V3DError) as error:
        return Outcome(sequence, peer, turn, None, str(error))
    poses = 0 if measured.trajectory is None else len(measured.trajectory)
    metrics: dict[str, Any] = {
        "frames": measured.frames,
        "fps": measured.frames / measured.seconds,
        "coverage": poses / measured.frames,
    }
    if truth is not None and measured.trajectory is not None:
        with suppress(InputError):  # too few poses to score
            metrics |= evaluate(truth, measured.trajectory, frames=measured.frames).to_dict()
    return Outcome(sequence, peer, turn, metrics)


def accuracy_table(outcomes: Sequence[Outcome], known: Mapping[str, Any], data_root: Path) -> Iterator[str]:
    """Yield a row per sequence: ATE of each configuration and peer that ran, then published ATE of other systems."""
    sequences = unique(outcome.sequence for outcome in outcomes)
    configurations = unique(outcome.configuration for outcome in outcomes)
    peers = {sequence: known_scores(sequence, known) for sequence in sequences}
    columns = unique(name for scores in peers.values() for name in scores)
    yield markdown_row(["sequence", "what", "frames", *configurations, *columns])
    yield markdown_row(["---"] * 2 + ["---:"] * (1 + len(configurations) + len(columns)))
    for sequence in sequences:
        runs = [outcome for outcome in outcomes if outcome.sequence == sequence]
        frames = unique(str(outcome.metrics["frames"]) for outcome in runs if outcome.metrics)
        scores = [ate_cell([o for o in runs if o.configuration == name]) for name in configurations]
        beside = [peers[sequence].get(name, "-") for name in columns]
        yield markdown_row([sequence, description(sequence, known, data_root), *(frames or ["-"]), *scores, *beside])


def runs_table(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield a row per sequence and configuration: frames by tracking status, coverage and speed."""
    yield markdown_row(["sequence", "configuration", "runs failed", *TrackingStatus, "coverage", "frames per second"])
    yield markdown_row(["---"] * 2 + ["---:"] * (3 + len(TrackingStatus)))
    for sequence, configuration in unique((outcome.sequence, outcome.configuration) for outcome in outcomes):
        runs = [o for o in outcomes if (o.sequence, o.configuration) == (sequence, configuration)]
        metrics = [outcome.metrics for outcome in runs if outcome.metrics is not None]
        failed = f"{len(runs) - len(metrics)} of {len(runs)}"
        statuses = [
            format_median_and_range([m[status] for m in metrics if status in m], ".0f") for status in TrackingStatus
        ]
        coverage = format_median_and_range([m["coverage"] for m in metrics if "coverage" in m], ".1%")
        fps = format_median_and_range([m["fps"] for m in metrics], ".1f")
        yield markdown_row([sequence, configuration, failed, *statuses, coverage, fps])


def accuracy_rows(outcomes: Sequence[Outcome]) -> Iterator[Row]:
    """Yield a row per sequence and system, for `storage`."""
    for sequence, system in unique((outcome.sequence, outcome.configuration) for outcome in outcomes):
        runs = [o for o in outcomes if (o.sequence, o.configuration) == (sequence, system)]
        metrics = [outcome.metrics for outcome in runs if outcome.metrics is not None]
        cells = {"sequence": Path(sequence).name, "system": system, "ate": ate_cell(runs)}
        if metrics:
            cells |= {
                "frames": str(metrics[0]["frames"]),
                "fps": format_median_and_range([m["fps"] for m in metrics], ".1f"),
            }
            if any(m.get("coverage", 1) < 1 for m in metrics):
                cells["poses"] = format_median_and_range([m["coverage"] for m in metrics], ".0%") + " of the frames"
        yield cells


def notes(outcomes: Sequence[Outcome], known: Mapping[str, Any]) -> Iterator[str]:
    """Yield remarks: every failure, and notes on the sequences and the peers."""
    yield from (f"- {outcome}" for outcome in outcomes if outcome.ate is None)
    notes_of: dict[str, list[str]] = {}
    for outcome in outcomes:
        sequence_notes = known["sequences"].get(Path(outcome.sequence).name, {}).get("notes", [])
        score_notes = outcome.metrics.get("notes", []) if outcome.metrics else []
        for note in [*sequence_notes, *score_notes]:
            notes_of.setdefault(note, []).append(outcome.sequence)
    yield from (f"- {', '.join(unique(sequences))}: {note}" for note, sequences in notes_of.items())
    if any(Path(outcome.sequence).name in known["sequences"] for outcome in outcomes):
        yield f"- {descriptions.about_peers()}"


def known_scores(sequence: str, known: Mapping[str, Any]) -> dict[str, str]:
    """Return the ATE RMSE in metres of systems that were measured elsewhere, by system."""
    if (paper := find_paper_sequence(sequence)) is not None:
        scores = load_paper_scores()["ate"][paper]
        return {f"{name} (paper)": f"{score.rmse:.4f}" for name, score in scores.items() if score.rmse is not None}
    scores = known["sequences"].get(Path(sequence).name, {}).get("ate", {})
    return {f"{name} (not rerun)": score for name, score in scores.items()}


def description(sequence: str, known: Mapping[str, Any], data_root: Path) -> str:
    """Return the description of a sequence in ``peers.yaml``, else the first line of its README."""
    name = Path(sequence).name
    if name in known["sequences"]:
        return known["sequences"][name]["what"]
    readme = data_root / sequence / "README.md"
    lines = readme.read_text(encoding="utf-8").splitlines() if readme.is_file() else []
    return next((line.lstrip("# ").removeprefix(f"{name}: ") for line in lines if line.strip()), "-")


def ate_cell(runs: Sequence[Outcome]) -> str:
    """Format median and range of the ATE over the seeds, and the number of failed runs."""
    failed = sum(outcome.metrics is None for outcome in runs)
    if failed == len(runs):
        return "failed"
    return format_median_and_range([run.ate for run in runs if run.ate is not None], ".4f") + (
        f", {failed} failed" if failed else ""
    )


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = make_parser("Accuracy on sequences in TUM layout, beside other systems, as Markdown.")
    parser.add_argument("--seqs", nargs="+", help="names of sequences [all in --data-root]")
    parser.add_argument("--seeds", type=int, default=3, help="number of runs of each, with seeds from 0 [3]")
    parser.add_argument("--configs", nargs="+", choices=CONFIGURATIONS, default=["full", "baseline"])
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=[], help="other systems to run [none]")
    add_vocabulary_option(parser)
    return parser


def main() -> None:
    """Run the requested configurations and peers and print the tables."""
    parser = arguments()
    options = parser.parse_args()
    sequences = unique(options.seqs or list_sequences(options.data_root))
    if options.seeds < 1:
        parser.error("--seeds: must be at least 1")
    if not sequences:
        parser.error(
            f"{options.data_root}: contains no sequence (folder with rgb.txt or associations.txt); choose another"
            " --data-root"
        )

    heading = make_heading(options.peers)
    lines = [*heading.lines(), ""]
    vocabulary = options.vocabulary
    if vocabulary is None and "pyorbslam3" in options.peers:
        try:
            vocabulary = trained_vocabulary(sequences, options.data_root)
        except V3DError as error:
            parser.error(str(error))
    outcomes = []
    for sequence in sequences:
        for configuration in unique(options.configs):
            for seed in range(options.seeds):
                outcomes.append(run(sequence, configuration, seed, options.data_root))
                print(outcomes[-1], file=sys.stderr)
        for peer in unique(options.peers):
            for turn in range(options.seeds):
                outcomes.append(run_peer(sequence, peer, turn, options.data_root, vocabulary))
                print(outcomes[-1], file=sys.stderr)
    lines += ["ATE RMSE in metres; of several seeds, the median [lowest-highest].", ""]
    lines += [
        *accuracy_table(outcomes, descriptions.PEERS, options.data_root),
        "",
        *runs_table(outcomes),
        "",
        *notes(outcomes, descriptions.PEERS),
    ]
    publish(lines, options, parser, {"accuracy": Measurement(heading, list(accuracy_rows(outcomes)))})


if __name__ == "__main__":
    main()
