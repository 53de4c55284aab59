"""The sequences that a benchmark runs on."""

from __future__ import annotations

from pathlib import Path

from contenders.vocabulary import vocabulary

from v3d_torch.datasets import load_sequence


def listed(data_root: Path) -> list[str]:
    """Names of the folders in TUM layout."""
    return sorted(
        {path.parent.name for name in ("rgb.txt", "associations.txt") for path in data_root.glob(f"*/{name}")}
    )


def located(name: str, data_root: Path) -> str:
    """The folder of that name, else the name, which ``--seq`` and ``load_sequence`` know what to do with."""
    folder = data_root / name
    return str(folder) if folder.is_dir() else name


def trained_vocabulary(names: list[str], data_root: Path) -> Path:
    """A vocabulary from all sequences of the folder, so that all benchmarks have the same; if none, from those named.

    Raises:
        InputError: a sequence is not there, or something in it is wrong.
    """
    return vocabulary(
        load_sequence(located(name, data_root), data_root=data_root) for name in listed(data_root) or names
    )
