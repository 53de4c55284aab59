"""Notebooks: each runs from its first cell to its last, with the variables of no other."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

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


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path: Path, client: NotebookClient) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    if path.stem in FEWER_FRAMES:
        (index,) = (i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", ()))
        lines = [f"{name} = {value!r}" for name, value in FEWER_FRAMES[path.stem].items()]
        assert all(f"\n{name} = " in f"\n{notebook.cells[index].source}" for name in FEWER_FRAMES[path.stem])
        notebook.cells.insert(index + 1, nbformat.v4.new_code_cell("\n".join(lines)))
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))  # the variables of the notebook before
    client.nb = notebook
    client.reset_execution_trackers()
    for index, cell in enumerate(notebook.cells):
        client.execute_cell(cell, index)


def test_notebooks_are_small_and_have_no_absolute_paths() -> None:
    assert NOTEBOOKS
    for path in NOTEBOOKS:
        assert path.stat().st_size < 500_000, f"{path.name}: make its figures smaller"
        assert not re.search(r"/(home|root|tmp|Users)/", path.read_text()), f"{path.name}: contains an absolute path"
