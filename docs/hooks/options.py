"""Tables of the options of commands, taken from the commands themselves."""

from __future__ import annotations

import html
import re
from importlib import import_module
from typing import Any

from typer.main import get_command

_PLACEHOLDER = re.compile(r"^<!-- options of (\w+) -->$", re.MULTILINE)

_SPECIAL = re.compile(r"[\[\]|*_]")
"""Characters that are markup in a table cell."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert the tables of a page; MkDocs calls this with the text of the page."""
    return _PLACEHOLDER.sub(lambda match: table(match[1]), markdown)


def table(name: str) -> str:
    """Return a table of the parameters of a command, as in its ``--help``."""
    command = get_command(import_module(f"v3d_torch.cli.{name}").app)
    context: Any = command.make_context(name, [], resilient_parsing=True)
    rows = ["| | |", "|---|---|"]
    for parameter in command.params:
        if parameter.name != "help" and (record := parameter.get_help_record(context)) is not None:
            spelling, meaning = (" ".join(text.split()) for text in record)
            escaped = _SPECIAL.sub(r"\\\g<0>", html.escape(meaning))
            rows.append(f"| `{spelling}` | {escaped} |")
    return "\n".join(rows)
