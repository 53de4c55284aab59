"""Coverage-guided fuzzing of one parser: ``python tests/helpers/fuzz.py "image list" -max_total_time=300``.

Needs ``pip install -e '.[fuzz]'``. Without a name, the script lists the parsers. All further arguments go to libFuzzer.
An input that crashes a parser is written to ``crash-*`` in the working directory: move it to
``tests/helpers/crashes/<parser>/``, where it becomes a regression test.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package helpers

with atheris.instrument_imports(include=["v3d_torch", "yaml", "helpers", "tarfile", "zipfile", "PIL"]):
    from helpers.fuzz_inputs import SEEDS
    from helpers.parsers import PARSERS, assert_valid, parse


def main() -> None:
    """Fuzz the parser named on the command line."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in PARSERS:
        sys.exit(f"give one of these parsers: {', '.join(PARSERS)}")
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", DeprecationWarning)
    with tempfile.TemporaryDirectory() as scratch:
        corpus = Path(scratch) / "corpus"
        corpus.mkdir()
        for number, seed in enumerate(SEEDS[name]):
            (corpus / f"{number}").write_bytes(seed)
        folder = Path(scratch) / "files"
        folder.mkdir()
        max_length = max(4096, *map(len, SEEDS[name]))
        limits = ["-rss_limit_mb=3000", "-timeout=20", f"-max_len={max_length}"]
        check = lambda data: assert_valid(parse(name, data, folder))  # noqa: E731
        atheris.Setup([sys.argv[0], *limits, *sys.argv[2:], str(corpus)], check)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
