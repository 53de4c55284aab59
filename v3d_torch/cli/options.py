"""Options that several commands have, and the creation of their Typer applications."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand
from typer.models import OptionInfo

DataRoot = Annotated[
    Path | None,
    typer.Option(
        help="Folder of named sequences, to which missing ones are downloaded [default: search $V3D_DATA and the cache,"
        " download to the cache]."
    ),
]
Camera = Annotated[
    str | None,
    typer.Option(
        help="Camera, in place of that of the source: a preset (tum_fr3), camera.yaml, K.txt, or a file of ORB-SLAM,"
        " Kalibr or ROS."
    ),
]
RgbTopic = Annotated[str | None, typer.Option(help="Topic of the colour images in a bag [detected].")]
DepthTopic = Annotated[str | None, typer.Option(help="Topic of the depth images in a bag [detected].")]
InfoTopic = Annotated[
    str | None, typer.Option(help="Topic of the camera info of the colour images in a bag [detected].")
]
Fps = Annotated[float | None, typer.Option(help="Frame rate in Hz, for a live camera or a source without timestamps.")]
SkipBroken = Annotated[
    bool,
    typer.Option(
        "--skip-broken",
        help="Skip broken frames of a stored sequence with a warning, at most 5 % of the frames or 10.",
    ),
]
Seeds = Annotated[
    int, typer.Option(min=1, help="Number of runs of each sequence and configuration, with seeds from 0.")
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Continue the batch in --out: run only what is missing or has failed.")
]


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"v3d-torch {version('v3d-torch')}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
]


def workers_option(default: str) -> OptionInfo:
    """Return the option for the number of runs at a time.

    Args:
        default: Default of the command, for the help text.
    """
    info: OptionInfo = typer.Option(
        min=1,
        help="Number of runs at a time. With more than one, each run has one thread, which changes run times but not"
        f" results. [{default}]",
    )
    return info


def make_app() -> typer.Typer:
    """Return the application of one command."""
    return typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


class MultiValueCommand(TyperCommand):
    """Command whose repeatable options also accept several values, as in ``--configs paper full``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line after inserting the name of the option before each further value."""
        repeatable = {name for option in self.params if getattr(option, "multiple", False) for name in option.opts}
        expanded: list[str] = []
        option = None
        for argument in args:
            if argument.startswith("-"):
                name = argument.partition("=")[0]
                option = name if name in repeatable else None
            elif option is not None and expanded[-1] != option:
                expanded.append(option)
            expanded.append(argument)
        return super().parse_args(ctx, expanded)
