"""Command ``v3d-torch batch``: many sequences, configurations and seeds, summarised in tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import (
    Camera,
    DataRoot,
    Fps,
    MultiValueCommand,
    Resume,
    Seeds,
    SkipBroken,
    make_app,
    workers_option,
)
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runtime.imports import quick_imports

app = make_app()


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
    seeds: Seeds = 1,
    workers: Annotated[int | None, workers_option("1; with --ray the number of cores of the cluster")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the results; with --ray, a folder that all machines share. [results/batch/<time>]"
        ),
    ] = None,
    resume: Resume = False,
    skip_broken: SkipBroken = False,
    data_root: DataRoot = None,
    camera: Camera = None,
    fps: Fps = None,
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
    with quick_imports():
        from v3d_torch.batch.runner import run_batch

    with exit_on_error():
        run_batch(
            seqs,
            configs or ["full"],
            seeds=seeds,
            workers=workers,
            out=out,
            resume=resume,
            data_root=data_root,
            camera=camera,
            fps=fps,
            ray=ray,
            skip_broken=skip_broken,
        )
