"""Command ``v3d-torch reproduce``: the paper's tables, with results of this machine beside the published ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.cli.batch import MultiValueCommand
from v3d_torch.io.paths import expand_user_paths

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command(cls=MultiValueCommand)
@expand_user_paths
def main(
    data_root: Annotated[
        Path | None, typer.Option(envvar="V3D_DATA", help="Folder of the sequences; missing ones are downloaded to it.")
    ] = None,
    download: Annotated[
        bool, typer.Option("--download/--no-download", help="Download missing sequences (gigabytes).")
    ] = True,
    configs: Annotated[
        list[str] | None,
        typer.Option(
            help="Configurations in the paper's tables. Takes several values and can be repeated. [full paper baseline]"
        ),
    ] = None,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Also run the variants of the ablation study and fill its table.")
    ] = False,
    seeds: Annotated[
        int, typer.Option(min=1, help="Number of runs of each sequence and configuration, with seeds from 0.")
    ] = 1,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of runs at a time. With more than one, each run has one thread, which changes run times but"
            " not results. [1]",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [results/reproduce/<time>].")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue in --out: run only what is missing or has failed.")
    ] = False,
) -> None:
    """Fill the tables of the paper with results of this machine.

    Runs the paper's eight sequences of the TUM RGB-D benchmark and downloads those that are missing.
    """
    from v3d_torch.batch.reproduction import TABLE_CONFIGS, run_reproduction
    from v3d_torch.runs.console import exit_on_error

    with exit_on_error():
        run_reproduction(
            configs or TABLE_CONFIGS,
            study=ablation,
            seeds=seeds,
            workers=workers,
            out=out,
            resume=resume,
            data_root=data_root,
            download=download,
        )
