"""``v3d-torch COMMAND`` or ``python -m v3d_torch COMMAND``: all commands of the package under one name."""

from __future__ import annotations

from importlib.metadata import version
from types import ModuleType
from typing import Annotated

import typer

from v3d_torch.cli import ablate, batch, evaluate, record, report, reproduce, run

COMMANDS: tuple[ModuleType, ...] = (run, batch, evaluate, ablate, reproduce, record, report)
"""Modules with one command each, which ``python -m v3d_torch.run`` and so on call as well."""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None, no_args_is_help=True)
for _module in COMMANDS:
    (_command,) = _module.app.registered_commands
    app.command(_module.__name__.rpartition(".")[2], cls=_command.cls)(_command.callback)


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"v3d-torch {version('v3d-torch')}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Say which version this is.")
    ] = False,
) -> None:
    """V3D-SLAM: track an RGB-D camera in a room where people move, and map what stands still."""


if __name__ == "__main__":
    app(prog_name="v3d-torch")
