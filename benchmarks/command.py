"""Command-line options and output that the benchmarks share."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from heading import make_heading
from sequences import locate_sequence
from storage import Measurement, Row, save
from tables import flat

from v3d_torch.errors import OutputError, V3DError
from v3d_torch.io.files import write_text


def make_parser(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options that all benchmarks have."""
    parser = argparse.ArgumentParser(description=description)
    data_root = Path(os.environ.get("V3D_DATA", "../shared/data"))
    parser.add_argument(
        "--data-root", type=Path, default=data_root, help="folder of sequences [$V3D_DATA, else ../shared/data]"
    )
    parser.add_argument("--out", type=Path, help="Markdown file to write in addition")
    parser.add_argument(
        "--save", action="store_true", help="store the rows in benchmarks/results, for docs/benchmarks.md"
    )
    return parser


def add_vocabulary_option(parser: argparse.ArgumentParser) -> None:
    """Add the option of the benchmarks that run ORB-SLAM3."""
    parser.add_argument(
        "--vocabulary", type=Path, help="vocabulary of pyorbslam3, in DBoW2's text format [trained on the sequences]"
    )


def add_sequences_option(parser: argparse.ArgumentParser, kind: str) -> None:
    """Add the option ``--seqs``, with the demo as its default; `kind` says what the sequences must have."""
    parser.add_argument("--seqs", nargs="+", default=["demo"], help=f"sequences with {kind} [demo]")


def publish_rows(
    parser: argparse.ArgumentParser,
    options: argparse.Namespace,
    name: str,
    headings: Mapping[str, str],
    measure: Callable[[str], Iterable[Row]],
    about: Iterable[str] = (),
    peers: tuple[str, ...] = (),
) -> None:
    """Measure each sequence of ``--seqs`` and publish the rows as one table.

    Args:
        parser: Reports a sequence that fails.
        options: Parsed options.
        name: Name of the file of the measurement.
        headings: Headings of the columns by cell.
        measure: Returns the rows of a sequence, given as `load_sequence` takes it.
        about: Lines below the table.
        peers: Further packages whose versions to record.
    """
    heading = make_heading(peers)
    try:
        rows = [row for sequence in options.seqs for row in measure(locate_sequence(sequence, options.data_root))]
    except V3DError as error:
        parser.error(str(error))
    lines = [*heading.lines(), "", *flat(rows, headings), *about]
    publish(lines, options, parser, {name: Measurement(heading, rows)})


def publish(
    lines: Iterable[str],
    options: argparse.Namespace,
    parser: argparse.ArgumentParser,
    measurements: Mapping[str, Measurement],
) -> None:
    """Print a page, write it to the file of ``--out``, and store the measurements if ``--save`` is given.

    Args:
        lines: Lines of the page.
        options: Parsed options.
        parser: Reports a file that cannot be written.
        measurements: Measurements by the name of their file.
    """
    text = "\n".join(lines).rstrip() + "\n"
    print(text, end="")
    try:
        if options.out is not None:
            write_text(options.out, text)
        if options.save:
            for name, measurement in measurements.items():
                save(name, replace(measurement, heading=measurement.heading.until_now()))
    except OutputError as error:
        parser.error(str(error))
