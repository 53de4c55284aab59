"""What the command lines of the benchmarks that print Markdown have in common."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from pathlib import Path

from v3d_torch.errors import OutputError
from v3d_torch.io.files import write_text


def command_line(description: str) -> argparse.ArgumentParser:
    """A parser with the options of all."""
    parser = argparse.ArgumentParser(description=description)
    data_root = Path(os.environ.get("V3D_DATA", "../shared/data"))
    parser.add_argument(
        "--data-root", type=Path, default=data_root, help="folder of sequences [$V3D_DATA, else ../shared/data]"
    )
    parser.add_argument("--out", type=Path, help="Markdown file to write, too")
    return parser


def takes_vocabulary(parser: argparse.ArgumentParser) -> None:
    """Add the option of those that run ORB-SLAM3."""
    parser.add_argument(
        "--vocabulary", type=Path, help="of pyorbslam3, in DBoW2's text format [trained on the sequences]"
    )


def publish(lines: Iterable[str], options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Print the page, and write it where the options say so."""
    text = "\n".join(lines).rstrip() + "\n"
    print(text, end="")
    if options.out is not None:
        try:
            write_text(options.out, text)
        except OutputError as error:
            parser.error(str(error))
