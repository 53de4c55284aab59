"""Options that several commands have, and the creation of their Typer applications."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer
from typer.core import TyperCommand
from typer.models import CommandFunctionType, OptionInfo

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.errors import InputError

MAX_SEEDS = 1000
"""Maximum number of seeds: all runs of a batch are planned before the first one."""

_PATHS = (Path, Path | None)
"""Types of options that are paths."""

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
    int,
    typer.Option(min=1, max=MAX_SEEDS, help="Number of runs of each sequence and configuration, with seeds from 0."),
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


class PathCommand(TyperCommand):
    """Command that rejects empty paths: as a path, an empty text is the current folder."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line after checking its paths.

        They are checked here because Typer makes an empty text the path of the current folder, which later code cannot
        tell from a dot.
        """
        kinds = get_type_hints(self.callback)
        paths = {name for option in self.params if kinds.get(str(option.name)) in _PATHS for name in option.opts}
        for previous, argument in zip(["", *args], args, strict=False):
            name, equals, value = argument.partition("=")
            if not argument and previous in paths:
                _reject_empty(previous)
            if not argument and ("=" in previous or not previous.startswith("-")):
                _reject_empty("an argument")
            if equals and not value and name in paths:
                _reject_empty(name)
        return super().parse_args(ctx, args)


def _reject_empty(name: str) -> None:
    """Report a path that is empty, and exit."""
    with exit_on_error():
        raise InputError(f"{name}: is an empty path; give a path")


class _Application(typer.Typer):
    """Application whose commands are `PathCommand` by default."""

    def command(
        self, name: str | None = None, *, cls: type[TyperCommand] | None = PathCommand, **options: Any
    ) -> Callable[[CommandFunctionType], CommandFunctionType]:
        return super().command(name, cls=cls, **options)


def make_app() -> typer.Typer:
    """Return the application of one command."""
    return _Application(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


class MultiValueCommand(PathCommand):
    """Command whose repeatable options also accept several values, as in ``--configs paper full``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line after inserting the name of the option before each further value."""
        repeatable = {name for option in self.params if getattr(option, "multiple", False) for name in option.opts}
        expanded: list[str] = []
        option = None
        for argument in args:
            if argument.startswith("-"):
                if option is not None and expanded[-1] == option:  # else, the next option would be its value
                    with exit_on_error():
                        raise InputError(f"{option}: has no value before {argument}; give at least one")
                name = argument.partition("=")[0]
                option = name if name in repeatable else None
            elif option is not None and expanded[-1] != option:
                expanded.append(option)
            expanded.append(argument)
        return super().parse_args(ctx, expanded)
