"""Arbitrary bytes as input: every parser returns a valid result or raises V3DError, in bounded time and memory."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.fuzz_inputs import SEEDS
from helpers.parsers import PARSERS, assert_valid, parse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from v3d_torch.errors import V3DError

CRASHES = sorted((Path(__file__).parents[1] / "helpers" / "crashes").glob("*/*"))
"""Inputs that crashed a parser, by parser."""

SEARCH = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


@st.composite
def mutated(draw: st.DrawFn, seeds: list[bytes]) -> bytes:
    """Valid inputs with some bytes removed, inserted or overwritten."""
    content = draw(st.sampled_from(seeds))
    for _ in range(draw(st.integers(0, 4))):
        start = draw(st.integers(0, len(content)))
        length = draw(st.sampled_from([0, 1, 1, 2, 4, 16, len(content)]))
        new = draw(st.one_of(st.binary(max_size=8), st.sampled_from(TOKENS)))
        content = content[:start] + new + content[start + length :]
    return content


TOKENS = [
    b"nan",
    b"-inf",
    b"1e999",
    b"0",
    b"-1",
    b"\n",
    b",",
    b" ",
    b"\0",
    b"\xff\xff\xff\xff",
    b"\x7f\xff",
    b"&a ",
    b"*a",
    b"!!",
]
"""Tokens that are difficult for parsers."""


@pytest.mark.parametrize("parser", PARSERS)
def test_seeds_are_accepted_by_their_parser(parser: str, tmp_path: Path) -> None:
    assert any(not isinstance(parse(parser, seed, tmp_path), V3DError) for seed in SEEDS[parser])


@pytest.mark.timeout(200)
@pytest.mark.filterwarnings("error", "ignore::DeprecationWarning")
@pytest.mark.parametrize("parser", PARSERS)
@SEARCH
@given(data=st.data())
def test_mutated_and_random_bytes_are_parsed_or_rejected(parser: str, data: st.DataObject, tmp_path: Path) -> None:
    content = data.draw(st.one_of(mutated(SEEDS[parser]), st.binary(max_size=300)))
    assert_valid(parse(parser, content, tmp_path))


@pytest.mark.filterwarnings("error", "ignore::DeprecationWarning")
@pytest.mark.parametrize("path", CRASHES, ids=lambda path: f"{path.parent.name}: {path.name}")
def test_inputs_of_past_crashes_are_parsed_or_rejected(path: Path, tmp_path: Path) -> None:
    assert_valid(parse(path.parent.name, path.read_bytes(), tmp_path))
