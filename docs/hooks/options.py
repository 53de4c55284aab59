"""The options of a command, as a table in its page: taken from the command itself, so that they are always right."""

from __future__ import annotations

import html
import re
from importlib import import_module
from typing import Any

from typer.main import get_command

_WANTED = re.compile(r"^\{\{ options of (\w+) \}\}$", re.MULTILINE)

_SPECIAL = re.compile(r"[\[\]|*_]")
"""What would be markup in a cell."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by MkDocs with the text of each page."""
    return _WANTED.sub(lambda found: table(found[1]), markdown)


def table(name: str) -> str:
    """Rows of the parameters of the command ``<name>``, as its ``--help`` has them."""
    command = get_command(import_module(f"v3d_torch.cli.{name}").app)
    context: Any = command.make_context(name, [], resilient_parsing=True)
    rows = ["| | |", "|---|---|"]
    for parameter in command.params:
        if parameter.name != "help" and (record := parameter.get_help_record(context)) is not None:
            spelling, meaning = (" ".join(text.split()) for text in record)
            escaped = _SPECIAL.sub(r"\\\g<0>", html.escape(meaning))
            rows.append(f"| `{spelling}` | {escaped} |")
    return "\n".join(rows)
