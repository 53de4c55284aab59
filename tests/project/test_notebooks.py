"""Notebooks: each runs from its first cell to its last, with the variables of no other, also with other settings."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))

FEWER_FRAMES = {
    "quickstart": {"FRAMES": 32},
    "correct_depth_bias": {"TRAIN": ("demo", range(0, 60, 3)), "TEST": ("demo", range(60, 120, 12))},
    "learn_feature_uncertainty": {"TEST": [("demo", range(60, 120, 12))], "STEPS": 25},
    "learn_voting_thresholds": {"TEST": [("demo", range(60, 100, 8))]},
    "training_through_the_modules": {"TRAINING": 10, "TEST": 60, "STEPS": 40},
}
"""Settings of notebooks that replace those for readers: fewer frames, scenes and steps."""

CHECKS = {
    "learn_voting_thresholds": "assert max(CANDIDATES) < present.sum(dim=-1).max()",
    "quickstart": "assert scores.ate.rmse < 0.01",
    "voting_step_by_step": """
assert sorted(state for _, label, state in final if label.startswith("person")) == ["deforming", "dynamic", "static"]
""",
}
"""Checks of results that hold for the settings of the notebook only, after its last cell."""

OTHER_SETTINGS = (
    ("voting_step_by_step", {"INDEX": 3, "TIME_SPAN": 0.1}, "assert len(pairs) > 2"),  # the ends of the valid range
    ("voting_step_by_step", {"INDEX": 119, "TIME_SPAN": 0.9}, "assert len(pairs) > 2"),
    ("voting_step_by_step", {"INDEX": 100}, "assert len(pairs) > 2"),  # the border of the image cuts off a person
    # The photographer stands still, and a walker hides a part of him.
    ("voting_step_by_step", {"INDEX": 40}, "assert all(state != 'deforming' for _, _, state in final)"),
    ("correct_depth_bias", {"SCALE": 0.96, "OFFSET": -0.02}, ""),
)
"""Settings that a reader may choose: name of the notebook, values, and a check after its last cell."""


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NotebookClient]:
    """Client with a running kernel. All notebooks share it, because the import of the package takes seconds."""
    folder = tmp_path_factory.mktemp("notebooks")
    with pytest.MonkeyPatch.context() as patch:
        # Ignore the user's Jupyter settings: kernels of the same name and start-up files.
        patch.setenv("JUPYTER_DATA_DIR", str(folder / "jupyter"))
        patch.setenv("IPYTHONDIR", str(folder / "ipython"))
        patch.setenv("OMP_NUM_THREADS", "1")
        resources = {"metadata": {"path": folder}}
        client = NotebookClient(nbformat.v4.new_notebook(), timeout=120, kernel_name="python3", resources=resources)
        with client.setup_kernel():
            yield client


def run(path: Path, client: NotebookClient, settings: Mapping[str, Any], check: str = "") -> None:
    """Run a notebook with other settings than those for readers, then a check of its variables."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    if settings:
        (index,) = (i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", ()))
        assert all(f"\n{name} = " in f"\n{notebook.cells[index].source}" for name in settings)
        lines = [f"{name} = {value!r}" for name, value in settings.items()]
        notebook.cells.insert(index + 1, nbformat.v4.new_code_cell("\n".join(lines)))
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))  # the variables of the notebook before
    notebook.cells.append(nbformat.v4.new_code_cell(check))
    client.nb = notebook
    client.reset_execution_trackers()
    for index, cell in enumerate(notebook.cells):
        client.execute_cell(cell, index)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path: Path, client: NotebookClient) -> None:
    run(path, client, FEWER_FRAMES.get(path.stem, {}), CHECKS.get(path.stem, ""))


@pytest.mark.parametrize(("name", "settings", "check"), OTHER_SETTINGS, ids=str)
def test_notebook_runs_with_other_settings(
    name: str, settings: Mapping[str, Any], check: str, client: NotebookClient
) -> None:
    (path,) = (each for each in NOTEBOOKS if each.stem == name)
    run(path, client, FEWER_FRAMES.get(name, {}) | settings, check)


def test_quickstart_runs_without_ground_truth(moment: Path, tmp_path: Path, client: NotebookClient) -> None:
    folder = shutil.copytree(moment, tmp_path / "recording", ignore=shutil.ignore_patterns("groundtruth.txt"))
    (path,) = (each for each in NOTEBOOKS if each.stem == "quickstart")
    run(path, client, {"SEQUENCE": str(folder), "FRAMES": 6}, "assert sequence.groundtruth is None")


def test_notebooks_are_small_and_have_no_absolute_paths() -> None:
    assert NOTEBOOKS
    for path in NOTEBOOKS:
        assert path.stat().st_size < 500_000, f"{path.name}: make its figures smaller"
        assert not re.search(r"/(home|root|tmp|Users)/", path.read_text()), f"{path.name}: contains an absolute path"
