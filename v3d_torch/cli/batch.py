"""``python -m v3d_torch batch --seqs ...``: many sequences, configurations and seeds, and their tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from v3d_torch.io.paths import expand_user_paths

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


class SeveralValues(TyperCommand):
    """A command whose repeatable options also take several values at once: ``--configs paper full``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line after each further value has got its option's name before it."""
        repeatable = {name for option in self.params if getattr(option, "multiple", False) for name in option.opts}
        spread: list[str] = []
        option = None
        for argument in args:
            if argument.startswith("-"):
                name = argument.partition("=")[0]
                option = name if name in repeatable else None
            elif option is not None and spread[-1] != option:
                spread.append(option)
            spread.append(argument)
        return super().parse_args(ctx, spread)


@app.command(cls=SeveralValues)
@expand_user_paths
def main(
    seqs: Annotated[
        list[str],
        typer.Option(
            help="Sequences as run takes them, or patterns: fr3/w/*, data/*, or what --data-root holds. One or several,"
            " and again."
        ),
    ],
    configs: Annotated[
        list[str] | None,
        typer.Option(
            help="full, baseline, paper or another configuration of the package, or YAML files. One or several, and"
            " again. [full]"
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each, with seeds from 0.")] = 1,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Runs at a time. More than one have one thread each, which changes the time, not the results. [1; with"
            " --ray as many as the cluster has cores]",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results [results/batch/<time>]; with --ray, one that all share.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Run only what is missing in --out or has failed there.")
    ] = False,
    data_root: Annotated[
        Path | None, typer.Option(envvar="V3D_DATA", help="Where named sequences are, or are downloaded to.")
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(help="Run on a Ray cluster: auto for the one that this machine belongs to, local, or an address."),
    ] = None,
) -> None:
    """Run many sequences, configurations and seeds side by side.

    Each run is a process of its own; tables set the scores of all beside each other.
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
