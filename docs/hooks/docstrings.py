"""Conversion of docstrings from reStructuredText to the Markdown of the pages."""

from __future__ import annotations

import re
from textwrap import dedent, indent
from typing import Any

import griffe

_DISPLAYED = re.compile(r"^( *)\.\. math::\n((?:\n|\1 +.*(?:\n|$))+)", re.MULTILINE)
_ROLE = re.compile(r":(math|func|class):`([^`]+)`")


class ReadableDocstrings(griffe.Extension):
    r"""Converts formulas and roles: ``:math:`x``` to ``\(x\)``, ``.. math::`` to a block, ``:func:`f``` to code."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Convert the docstring of one object."""
        if obj.docstring is not None:
            obj.docstring.value = readable(obj.docstring.value)


def readable(text: str) -> str:
    """Return a docstring in Markdown."""
    text = _DISPLAYED.sub(lambda match: indent(f"\n$$\n{dedent(match[2]).strip()}\n$$\n\n", match[1]), text)
    return _ROLE.sub(lambda match: rf"\({match[2]}\)" if match[1] == "math" else f"`{match[2]}`", text)
