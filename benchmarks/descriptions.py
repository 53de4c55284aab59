"""Descriptions of the sequences, and results of systems that are not run, from ``peers.yaml``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from v3d_torch.datasets.sequence_names import BUILT_IN_SEQUENCES

PEERS: Mapping[str, Any] = yaml.safe_load(Path(__file__).with_name("peers.yaml").read_text(encoding="utf-8"))


def kind(sequence: str) -> str:
    """Return the kind of a sequence: real, composed, simulated or not described."""
    if sequence in BUILT_IN_SEQUENCES:
        return "simulated"
    return PEERS["sequences"].get(sequence, {}).get("kind", "not described")


def describe(sequence: str) -> str:
    """Return name, kind and short description of a sequence."""
    described = PEERS["sequences"].get(sequence)
    return f"{sequence} ({described['kind']}; {described['short']})" if described else f"{sequence} ({kind(sequence)})"


def published(sequence: str) -> Mapping[str, str]:
    """Return the ATE of systems that were measured elsewhere."""
    return PEERS["sequences"].get(sequence, {}).get("ate", {})


def sequence_list() -> Iterator[str]:
    """Yield a line per sequence with its description."""
    yield from (f"- `{name}`: {described['what']}" for name, described in PEERS["sequences"].items())


def sequence_notes() -> Iterator[tuple[str, str]]:
    """Yield each note on sequences and the names of the sequences."""
    names: dict[str, list[str]] = {}
    for name, described in PEERS["sequences"].items():
        for note in described.get("notes", []):
            names.setdefault(note, []).append(name)
    yield from ((note, ", ".join(sequences)) for note, sequences in names.items())
