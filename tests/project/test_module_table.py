"""The table of the functions of tensors in the documentation: cells are as measured, no public function is missing."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
from helpers.module_table import CASES_BY_FUNCTION, COLUMNS, REASONS, measure

import v3d_torch as v3d

PAGE = Path(__file__).parents[2] / "docs" / "modules.md"


def rows() -> dict[str, list[str]]:
    """Cells of the table on the page, with the reasons instead of their numbers."""
    text = PAGE.read_text(encoding="utf-8")
    reasons = {f"({number})": reason for number, reason in re.findall(r"^(\d+)\. (.+)$", text, re.MULTILINE)}
    table = {}
    for line in text[text.index("| function |") :].splitlines()[2:]:
        if not line.startswith("|"):
            break
        name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        table[name.replace("`", "")] = [reasons.get(cell, cell) for cell in cells]
    return table


@pytest.mark.parametrize("name", CASES_BY_FUNCTION)
def test_page_states_what_each_function_was_measured_to_support(name: str) -> None:
    assert rows()[name] == [measure(name, column) for column in COLUMNS]


def test_every_public_function_of_tensors_has_a_row() -> None:
    def takes_tensors(function: object) -> bool:
        first = next(iter(inspect.signature(function).parameters.values()), None)
        return first is not None and first.annotation in ("Tensor", "Tensor | float")

    public = {name: getattr(v3d, name) for name in v3d.__all__}
    functions = {name for name, each in public.items() if inspect.isfunction(each) and takes_tensors(each)}
    assert functions == {name.partition(",")[0] for name in CASES_BY_FUNCTION}


def test_reasons_belong_to_cells() -> None:
    assert {name for name, _ in REASONS} <= CASES_BY_FUNCTION.keys()
    assert {column for _, column in REASONS} <= COLUMNS.keys()
