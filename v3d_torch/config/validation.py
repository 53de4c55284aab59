"""Values and keys given by users: conversion to numbers, the key that was meant, and description of pydantic errors."""

from __future__ import annotations

import difflib
import math
import reprlib
from collections.abc import Iterable

from pydantic import ValidationError

_MIN_SIMILARITY = 0.5
"""Minimum similarity of an unknown key and the one that is suggested: others have no more in common than any words."""


def first_error(error: ValidationError) -> str:
    """Describe the first error of a validation: key, rule and value; a long value is shortened."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"]) or "the document"
    rule = "input should be a valid dictionary of keys" if first["type"] == "model_type" else first["msg"].lower()
    return f"{key}: {rule}, got {reprlib.repr(first['input'])}"


def similar_key(key: str, known: Iterable[str]) -> str | None:
    """Return the known key that is most similar to an unknown one; None if none is similar."""
    near = difflib.get_close_matches(key.lower(), known, n=1, cutoff=_MIN_SIMILARITY)
    return near[0] if near else None


def to_float(value: object) -> float:
    """Convert a number, or a text or array that holds one, to float; return NaN if that is not possible."""
    try:
        return float(value)  # type: ignore[arg-type]  # any object is tried
    except (TypeError, ValueError):
        return math.nan
