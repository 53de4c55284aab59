"""Conversion of values given by users to numbers, and description of pydantic errors."""

from __future__ import annotations

import math
import reprlib

from pydantic import ValidationError


def first_error(error: ValidationError) -> str:
    """Describe the first error of a validation: key, rule and value; a long value is shortened."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"]) or "the document"
    rule = "input should be a valid dictionary of keys" if first["type"] == "model_type" else first["msg"].lower()
    return f"{key}: {rule}, got {reprlib.repr(first['input'])}"


def to_float(value: object) -> float:
    """Convert a number, or a text or array that holds one, to float; return NaN if that is not possible."""
    try:
        return float(value)  # type: ignore[arg-type]  # any object is tried
    except (TypeError, ValueError):
        return math.nan
