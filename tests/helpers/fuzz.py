"""Coverage-guided fuzzing of one parser, by hand: ``python tests/helpers/fuzz.py "image list" -max_total_time=300``.

Needs ``pip install -e '.[fuzz]'``. The parsers are those of `parsers`; without a name they are listed. What follows the
name goes to libFuzzer. An input that breaks a parser is written to ``crash-*`` in the working directory: put it into
``tests/helpers/crashes/<parser>/``, where a test keeps it.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["v3d_torch", "yaml", "parsers", "tarfile", "zipfile", "PIL"]):
    from helpers.parsers import PARSERS, assert_sound, outcome
    from helpers.seeds import SEEDS


def main() -> None:
    """Fuzz the parser that the command line names."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in PARSERS:
        sys.exit(f"name one of: {', '.join(PARSERS)}")
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", DeprecationWarning)
    with tempfile.TemporaryDirectory() as scratch:
        corpus = Path(scratch) / "corpus"
        corpus.mkdir()
        for number, seed in enumerate(SEEDS[name]):
            (corpus / f"{number}").write_bytes(seed)
        folder = Path(scratch) / "files"
        folder.mkdir()
        longest = max(4096, *map(len, SEEDS[name]))
        limits = ["-rss_limit_mb=3000", "-timeout=20", f"-max_len={longest}"]
        parse = lambda data: assert_sound(outcome(name, data, folder))  # noqa: E731
        atheris.Setup([sys.argv[0], *limits, *sys.argv[2:], str(corpus)], parse)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
