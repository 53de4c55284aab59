"""What is given, and whether it can be taken: numbers, and in words what a model refuses."""

from __future__ import annotations

import math
import reprlib

from pydantic import ValidationError


def first_error(error: ValidationError) -> str:
    """The first of the values that a model refuses: its key, the rule and the value, cut where it is long."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"]) or "the whole"
    rule = "input should be a valid dictionary of keys" if first["type"] == "model_type" else first["msg"].lower()
    return f"{key}: {rule}, got {reprlib.repr(first['input'])}"


def to_float(value: object) -> float:
    """A number of any kind, or a text or array that holds one; NaN where it is none."""
    try:
        return float(value)  # type: ignore[arg-type]  # that is the question
    except (TypeError, ValueError):
        return math.nan
