"""Numbers in text files of other programs."""

from __future__ import annotations

import re

_WINDOWS_NON_FINITE = re.compile(r"[+-]?1\.#[A-Z]+\d*", re.IGNORECASE)
"""Numbers that are not finite, as programs on Windows write them: ``-1.#INF00``, ``1.#QNAN``, ``-1.#IND``."""


def parse_number(word: str) -> float:
    """Parse a number.

    Args:
        word: Number; ``nan``, ``inf`` and what programs on Windows write for them are accepted.

    Returns:
        The number; NaN for any number of Windows that is not finite.

    Raises:
        ValueError: If the word is not a number.
    """
    # Python also accepts 1_000 and digits of other scripts; in a file they are damage.
    if "_" in word or not word.isascii():
        raise ValueError(f"{word} is not a number")
    return float("nan") if _WINDOWS_NON_FINITE.fullmatch(word) else float(word)
