"""Conversion of formulas to MathML, which browsers draw without a script."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Convert the formulas of a page; MkDocs calls this with the HTML of the page."""
    return _FORMULA.sub(
        lambda match: convert(html.unescape(match[2]).strip(), display="block" if match[1] == "div" else "inline"),
        content,
    )
