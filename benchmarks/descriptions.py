"""Descriptions of the sequences, and results of systems that are not run, from ``peers.yaml``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from v3d_torch.datasets.sequence_names import BUILT_IN_SEQUENCES

PEERS: Mapping[str, Any] = yaml.safe_load(Path(__file__).with_name("peers.yaml").read_text(encoding="utf-8"))


def about_peers() -> str:
    """Return how the systems that are not run were measured, and their speed."""
    return str(PEERS["about"]).format(fps=peer_speeds("fps"), cpu_ms=peer_speeds("cpu_ms"))


def peer_speeds(quantity: str) -> str:
    """Return a speed of each system that is not run, in the order of `peer_names`; ``fps`` or ``cpu_ms``."""
    return _enumerate(str(speeds[quantity]) for speeds in PEERS["speed"].values())


def peer_names() -> str:
    """Return the names of the systems that are not run."""
    return _enumerate(PEERS["speed"])


def _enumerate(texts: Iterable[str]) -> str:
    *first, last = texts
    return f"{', '.join(first)} and {last}"


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
