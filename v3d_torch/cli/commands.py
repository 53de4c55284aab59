"""All commands of the package, as one application."""

from __future__ import annotations

from types import ModuleType

import typer

from v3d_torch.cli import ablate, batch, calibrate, evaluate, export, record, report, reproduce, run
from v3d_torch.cli.options import Version

COMMANDS: tuple[ModuleType, ...] = (run, batch, calibrate, evaluate, ablate, reproduce, record, report, export)
"""Modules that define one command each; the command has the name of its module."""


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None, no_args_is_help=True)
for _module in COMMANDS:
    (_command,) = _module.app.registered_commands
    app.command(_module.__name__.rpartition(".")[2], cls=_command.cls)(_command.callback)


@app.callback()
def main(version: Version = False) -> None:
    """V3D-SLAM: RGB-D SLAM for dynamic indoor scenes."""
