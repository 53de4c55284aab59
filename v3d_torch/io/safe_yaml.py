"""YAML that somebody else may have written: plain values, small, and no more in memory than in the text."""

from __future__ import annotations

from collections import Counter
from typing import Any

import yaml

_MAX_LENGTH = 100_000
"""Letters; what is read here has a few thousand, and the parser takes a second for this."""


def parse_yaml(text: str) -> Any:
    """The value that a YAML text stands for.

    Tags for objects are refused, as `yaml.safe_load` does; so are aliases, with which a few lines can stand for
    gigabytes, and a key that is given twice, of which YAML would silently take the last.

    Raises:
        ValueError: it is no such YAML; the message says why in a few words, with the line where it can.
    """
    if len(text) > _MAX_LENGTH:
        raise ValueError(f"it has {len(text)} letters, more than {_MAX_LENGTH}")
    try:
        return yaml.load(text, _PlainLoader)  # noqa: S506 - a safe loader
    except yaml.MarkedYAMLError as error:
        where = f"line {error.problem_mark.line + 1}: " if error.problem_mark is not None else ""
        raise ValueError(f"{where}{error.problem}") from error
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except Exception as error:  # of the many that dates, Booleans and numbers raise that are none
        raise ValueError(str(error).splitlines()[0] if str(error) else type(error).__name__) from error


class _PlainLoader(yaml.SafeLoader):
    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            alias = self.peek_event()
            raise yaml.MarkedYAMLError(problem=f"write *{alias.anchor} out", problem_mark=alias.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if twice := [key for key, count in keys.items() if count > 1]:
            raise yaml.MarkedYAMLError(problem=f"{twice[0]!r} is given twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)
