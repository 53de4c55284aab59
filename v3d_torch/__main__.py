"""Program ``v3d-torch``, also ``python -m v3d_torch``: all commands of the package."""

from __future__ import annotations

from importlib.metadata import version
from types import ModuleType
from typing import Annotated

import typer

from v3d_torch.cli import ablate, batch, evaluate, export, record, report, reproduce, run

COMMANDS: tuple[ModuleType, ...] = (run, batch, evaluate, ablate, reproduce, record, report, export)
"""Modules that define one command each; the command has the name of its module."""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None, no_args_is_help=True)
for _module in COMMANDS:
    (_command,) = _module.app.registered_commands
    app.command(_module.__name__.rpartition(".")[2], cls=_command.cls)(_command.callback)


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"v3d-torch {version('v3d-torch')}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """V3D-SLAM: RGB-D SLAM for dynamic indoor scenes."""


if __name__ == "__main__":
    app(prog_name="v3d-torch")
