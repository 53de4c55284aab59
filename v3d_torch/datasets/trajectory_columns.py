"""Columns of a trajectory file, whose order a comment before the poses can state."""

from __future__ import annotations

import re

TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
"""Columns of the TUM format in their order."""

_UNIT = re.compile(r"\[[^\]]*\]")

_NAME = re.compile(r"(?P<stamp>time\w*|stamp)|(?:[tp]|p_(?:\w+_)?)(?P<t>[xyz])|q_?(?:\w+_)?(?P<q>[xyzw])")
"""Names of a column: ``timestamp``, ``tx``, ``px``, ``p_x`` or ``p_rs_r_x``, ``qx``, ``q_x`` or ``q_rs_x``."""


def read_header(comment: str) -> list[str] | None:
    """Read the names of the columns from a comment.

    Args:
        comment: Line such as ``# timestamp tx ty tz qx qy qz qw`` or, of EuRoC and evo,
            ``#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []``.

    Returns:
        Name of each column, those of `TUM_COLUMNS` as there; None if the comment does not name all of them.
    """
    words = re.split(r"[\s,;]+", _UNIT.sub(" ", comment.lstrip("# \t")).strip(" ,;"))
    names = [_plain_name(word.lower()) for word in words]
    return names if all(names.count(column) == 1 for column in TUM_COLUMNS) else None


def _plain_name(word: str) -> str:
    """Return the name of a column as in `TUM_COLUMNS`; any other word is returned unchanged."""
    match = _NAME.fullmatch(word)
    if match is None:
        return word
    return "timestamp" if match["stamp"] else f"t{match['t']}" if match["t"] else f"q{match['q']}"
