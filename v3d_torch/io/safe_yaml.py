"""YAML from untrusted files: plain values only, of bounded size, without aliases and duplicate keys."""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import yaml

from v3d_torch.io.text import first_line
from v3d_torch.io.text_file import replace_odd_spaces

_MAX_LENGTH = 100_000
"""Maximum length of a YAML text, characters: longer than any valid file, and short enough for a slow parser."""


_OPENCV_HEADER, _OPENCV_MATRIX = "%YAML:1.0", "!!opencv-matrix"
"""First line and matrix tag of OpenCV's files. Neither is valid YAML."""

_DOCUMENT_START = re.compile(r"^---\s*$", re.MULTILINE)
"""Line before a document. Before the first one, there can be comments and directives such as ``%YAML 1.2``."""

_CONTENT = re.compile(r"^\s*[^\s#%]", re.MULTILINE)
"""Line of a document that is neither empty, nor a comment or a directive."""


def to_valid_yaml(text: str) -> str:
    """Convert a file of OpenCV or ROS to a single valid YAML document, and replace odd spaces.

    OpenCV's own parser is not robust against damaged files. ``rostopic echo`` ends each message with ``---``.

    Args:
        text: Content of a file.

    Returns:
        The first document, without OpenCV's header and its matrix tags: a matrix is a mapping with the key ``data``.
    """
    text = replace_odd_spaces(text).strip().removeprefix(_OPENCV_HEADER).replace(_OPENCV_MATRIX, "")
    documents = _DOCUMENT_START.split(text)
    return next((document for document in documents if _CONTENT.search(document) is not None), "")


def parse_yaml(text: str) -> Any:
    """Parse a YAML text.

    Like `yaml.safe_load` this rejects tags that create Python objects. It also rejects aliases, with which a few lines
    can expand to gigabytes, and duplicate keys, of which PyYAML silently keeps the last.

    Args:
        text: YAML text, at most 100000 characters.

    Returns:
        The parsed value; None for an empty text.

    Raises:
        ValueError: If the text is not valid; the message is the cause, with the line number if known.
    """
    if len(text) > _MAX_LENGTH:
        raise ValueError(f"it has {len(text)} characters, more than {_MAX_LENGTH}")
    try:
        return yaml.load(text, _StrictLoader)  # noqa: S506 - derived from the safe loader
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark is not None else ""
        raise ValueError(f"{line}{error.problem}") from error
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except Exception as error:  # PyYAML converts dates, Booleans and numbers without checks: any error can result
        raise ValueError(first_line(error)) from error


class _StrictLoader(yaml.SafeLoader):
    """Safe loader that rejects aliases and duplicate keys."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            alias = self.peek_event()
            raise yaml.MarkedYAMLError(
                problem=f"alias *{alias.anchor} is not allowed, write its value", problem_mark=alias.start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if duplicates := [key for key, count in keys.items() if count > 1]:
            raise yaml.MarkedYAMLError(problem=f"duplicate key {duplicates[0]!r}", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)
