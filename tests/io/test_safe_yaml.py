"""YAML from untrusted files: the same values as `yaml.safe_load`, and rejected constructs."""

from __future__ import annotations

import math

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.io.safe_yaml import parse_yaml

LINE_BREAKS = set("\x85\u2028\u2029")
CHARACTERS = st.characters(exclude_categories=["Cs"])  # the default alphabet takes seconds to compute
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**9), 10**9)
    | st.floats(allow_nan=False)
    | st.text(CHARACTERS, max_size=12)
)
TREES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(CHARACTERS, max_size=8), inner, max_size=4),
    max_leaves=12,
)


class DumperWithoutAliases(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True


@given(tree=TREES)
def test_values_are_those_of_safe_load(tree: object) -> None:
    for allow_unicode in (False, True):
        text = yaml.dump(tree, Dumper=DumperWithoutAliases, allow_unicode=allow_unicode)
        assert parse_yaml(text) == yaml.safe_load(text)
        if not LINE_BREAKS & set(text):  # PyYAML writes these unescaped and reads them as spaces
            assert parse_yaml(text) == tree


def test_byte_order_mark_infinity_and_empty_text_are_parsed() -> None:
    assert parse_yaml("\ufefflimit: .inf\r\n") == {"limit": math.inf}
    assert parse_yaml("") is None


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("a: &x 1\nb: *x\n", r"line 2: alias \*x is not allowed, write its value"),
        ("a: &x [*x]\n", r"line 1: alias \*x is not allowed, write its value"),
        ("a: 1\nb:\n  c: 1\n  c: 2\n", "line 3: duplicate key 'c'"),
        ("a: [1\n", "line 2: expected"),
        ("\ta: 1\n", "line 1: found character"),
        ("!!python/object/apply:os.system ['true']", "line 1: could not determine a constructor"),
        ("!!bool perhaps", "perhaps"),
        ("!!timestamp now", "NoneType"),
        ("2024-13-01", "month"),
        (5000 * "1", "5000 digits"),
        ("? [a]\n: 1\n", "unhashable"),
        (2000 * "[" + 2000 * "]", "nested too deeply"),
        (200_000 * "a", "200000 characters"),
    ],
)
def test_rejected_text_raises_with_its_cause(text: str, cause: str) -> None:
    with pytest.raises(ValueError, match=cause) as caught:
        parse_yaml(text)
    assert "\n" not in str(caught.value)
