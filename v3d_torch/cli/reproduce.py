"""``python -m v3d_torch reproduce``: the paper's eight sequences, and its tables with our figures beside its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.cli.batch import SeveralValues
from v3d_torch.io.paths import expand_user_paths

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command(cls=SeveralValues)
@expand_user_paths
def main(
    data_root: Annotated[
        Path | None, typer.Option(envvar="V3D_DATA", help="Where the sequences are, or are downloaded to.")
    ] = None,
    download: Annotated[
        bool, typer.Option("--download/--no-download", help="Download the sequences that are not here, gigabytes.")
    ] = True,
    configs: Annotated[
        list[str] | None,
        typer.Option(help="Configurations for the paper's tables. One or several, and again. [full paper baseline]"),
    ] = None,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Run the variants of the ablation study, too, and fill its table.")
    ] = False,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each, with seeds from 0.")] = 1,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Runs at a time. More than one have one thread each, which changes the time, not the results. [1]",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [results/reproduce/<time>].")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Run only what is missing in --out or has failed there.")
    ] = False,
) -> None:
    """Fill the tables of the paper with figures of this machine.

    Runs its eight sequences of the TUM RGB-D benchmark, downloaded where they are not here.
    """
    from v3d_torch.batch.reproduction import CONFIGS, run_reproduction
    from v3d_torch.runs.console import exit_on_error

    with exit_on_error():
        run_reproduction(
            configs or CONFIGS,
            study=ablation,
            seeds=seeds,
            workers=workers,
            out=out,
            resume=resume,
            data_root=data_root,
            download=download,
        )
