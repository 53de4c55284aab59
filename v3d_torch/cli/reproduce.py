"""Command ``v3d-torch reproduce``: the paper's tables, with results of this machine beside the published ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import DataRoot, MultiValueCommand, Resume, Seeds, make_app, workers_option
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runtime.imports import quick_imports

app = make_app()


@app.command(cls=MultiValueCommand)
@expand_user_paths
def main(
    data_root: DataRoot = None,
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
    seeds: Seeds = 1,
    workers: Annotated[int | None, workers_option("1")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [results/reproduce/<time>].")] = None,
    resume: Resume = False,
) -> None:
    """Fill the tables of the paper with results of this machine.

    Runs the paper's eight sequences of the TUM RGB-D benchmark and downloads those that are missing.
    """
    with quick_imports():
        from v3d_torch.batch.reproduction import TABLE_CONFIGS, run_reproduction

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
