"""Docstrings as they are written, in reStructuredText where it matters, to the Markdown that the pages are made of."""

from __future__ import annotations

import re
from textwrap import dedent, indent
from typing import Any

import griffe

_DISPLAYED = re.compile(r"^( *)\.\. math::\n((?:\n|\1 +.*(?:\n|$))+)", re.MULTILINE)
_ROLE = re.compile(r":(math|func|class):`([^`]+)`")


class ReadableDocstrings(griffe.Extension):
    r"""Formulas and roles: ``:math:`x``` becomes ``\(x\)``, ``.. math::`` a block, ``:func:`f``` the name as code."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of one object."""
        if obj.docstring is not None:
            obj.docstring.value = readable(obj.docstring.value)


def readable(text: str) -> str:
    """A docstring in Markdown."""
    text = _DISPLAYED.sub(lambda found: indent(f"\n$$\n{dedent(found[2]).strip()}\n$$\n\n", found[1]), text)
    return _ROLE.sub(lambda found: rf"\({found[2]}\)" if found[1] == "math" else f"`{found[2]}`", text)
