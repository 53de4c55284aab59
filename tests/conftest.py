"""Shared fixtures: where real sequences are, one thread for the same bytes everywhere."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from v3d_torch.datasets.demo.sequence import write_sequence

torch.set_num_threads(1)

SLOWEST = ("test_real_sequences.py", "cli/test_run.py", "test_corpus.py", "cli/test_ablate.py")
"""Begin with these, so that with several workers (``-n 2``) none is left alone with one of them in the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long first, each with its tests in their order."""
    items.sort(key=lambda item: SLOWEST.index(item.path.name) if item.path.name in SLOWEST else len(SLOWEST))


collect_ignore = ["test_corpus.py"] if os.name == "nt" else []
"""Full disks and little memory are made with the limits of Unix."""


@pytest.fixture(scope="session")
def moment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fifth of a second of the demo, six frames with true masks, in which the walker is in the middle of the room."""
    folder = tmp_path_factory.mktemp("sequences") / "moment"
    write_sequence(folder, range(52, 58))
    return folder


@pytest.fixture(scope="session")
def v3d_data() -> Path:
    """Folder of real and composed sequences: ``$V3D_DATA``, else ``../shared/data`` beside the checkout."""
    root = Path(os.environ.get("V3D_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"no real data: {root} is not there; set V3D_DATA to a folder of TUM-layout sequences")
    return root
