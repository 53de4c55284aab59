"""Sequences that a benchmark runs on."""

from __future__ import annotations

from pathlib import Path

from systems.vocabulary import vocabulary

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.base import RGBDStream


def list_sequences(data_root: Path) -> list[str]:
    """Return the names of the folders in TUM layout."""
    return sorted(
        {path.parent.name for name in ("rgb.txt", "associations.txt") for path in data_root.glob(f"*/{name}")}
    )


def locate_sequence(name: str, data_root: Path) -> str:
    """Return the folder of a sequence in the data root, else its name, as `load_sequence` takes it."""
    folder = data_root / name
    return str(folder) if folder.is_dir() else name


def table_name(sequence: RGBDStream) -> str:
    """Return the name of a sequence in tables, without slashes: ``fr1_rpy`` for ``fr1/rpy``."""
    return sequence.name.replace("/", "_")


def trained_vocabulary(names: list[str], data_root: Path) -> Path:
    """Return a vocabulary trained on all sequences of the folder, so that all benchmarks use the same one.

    Args:
        names: Sequences to train on if the folder has none.
        data_root: Folder of sequences.

    Raises:
        InputError: If a sequence is missing or damaged.
    """
    return vocabulary(
        load_sequence(locate_sequence(name, data_root), data_root=data_root)
        for name in list_sequences(data_root) or names
    )
