"""Command ``v3d-torch batch``: many sequences, configurations and seeds, summarised in tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from v3d_torch.io.paths import expand_user_paths

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


class MultiValueCommand(TyperCommand):
    """Command whose repeatable options also accept several values at once: ``--configs paper full``."""

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


@app.command(cls=MultiValueCommand)
@expand_user_paths
def main(
    seqs: Annotated[
        list[str],
        typer.Option(
            help="Sequences, as the run command takes them, or patterns for names and folders: fr3/w/*, data/*. Takes"
            " several values and can be repeated."
        ),
    ],
    configs: Annotated[
        list[str] | None,
        typer.Option(
            help="Configurations: full, baseline, paper or another one of the package, or YAML files. Takes several"
            " values and can be repeated. [full]"
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option(min=1, help="Number of runs of each sequence and configuration, with seeds from 0.")
    ] = 1,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of runs at a time. With more than one, each run has one thread, which changes run times but"
            " not results. [1; with --ray the number of cores of the cluster]",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the results; with --ray, a folder that all machines share. [results/batch/<time>]"
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the batch in --out: run only what is missing or has failed.")
    ] = False,
    data_root: Annotated[
        Path | None,
        typer.Option(envvar="V3D_DATA", help="Folder of named sequences; missing ones are downloaded to it."),
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(
            help="Run on a Ray cluster: auto for the cluster of this machine, local for a new one on this machine, or"
            " an address (HOST:PORT)."
        ),
    ] = None,
) -> None:
    """Run many sequences, configurations and seeds.

    Each run has its own process. Tables compare the scores of all runs.
    """
    from v3d_torch.batch.runner import run_batch
    from v3d_torch.runs.console import exit_on_error

    with exit_on_error():
        run_batch(
            seqs,
            configs or ["full"],
            seeds=seeds,
            workers=workers,
            out=out,
            resume=resume,
            data_root=data_root,
            ray=ray,
        )
