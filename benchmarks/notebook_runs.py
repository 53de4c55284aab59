"""Runs of the notebooks with other settings than those for readers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"

_SETTINGS = "parameters"
"""Tag of the cell with the settings, as papermill uses it."""


def run_notebook(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Run the code of a notebook.

    Args:
        name: Name of the notebook.
        settings: Values of variables that replace those of its cell with settings.

    Returns:
        All variables at its end.
    """
    names: dict[str, Any] = {"__name__": name}
    cells = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    for cell in cells:
        if cell["cell_type"] == "code":
            lines = (line for line in cell["source"] if not line.startswith("%"))  # commands of IPython
            exec(compile("".join(lines), name, "exec"), names)  # noqa: S102
        if _SETTINGS in cell["metadata"].get("tags", ()):
            unknown = settings.keys() - names.keys()
            if unknown:
                raise KeyError(f"{name}.ipynb has no settings {sorted(unknown)}")
            names |= settings
    return names
