"""Command ``v3d-torch ablate``: the ablation study, which shows the effect of each part of the method."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import MAX_SEEDS, Camera, DataRoot, Fps, make_app
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runtime.imports import quick_imports

app = make_app()


@app.command()
@expand_user_paths
def main(
    seq: Annotated[
        list[str],
        typer.Option(
            help="Sequence to run: demo, demo:sitting, demo:things, a TUM RGB-D sequence or a folder."
            " Repeat the option for several."
        ),
    ],
    data_root: DataRoot = None,
    camera: Camera = None,
    fps: Fps = None,
    variants: Annotated[str, typer.Option(help="Variants to run, separated by commas.")] = (
        "baseline, no_voting, no_free_space, no_chamfer, no_prediction, no_appearance, no_unlabelled, not_upright,"
        " global_shutter, paper, full"
    ),
    seeds: Annotated[
        int, typer.Option(min=1, max=MAX_SEEDS, help="Number of runs of each variant, with seeds from 0.")
    ] = 3,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Configuration value for all variants, such as segmentation.model=yolo11n-seg."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [results/ablation/<time>].")] = None,
) -> None:
    """Turn off parts of the system and compare the scores.

    Each variant runs with each seed on each sequence, one run after the other.
    """
    with quick_imports():
        from v3d_torch.batch.ablation_study import run_ablation_study

    with exit_on_error():
        names = [name.strip() for name in variants.split(",")]
        run_ablation_study(
            seq, names, seeds=seeds, overrides=set_ or [], data_root=data_root, camera=camera, fps=fps, out=out
        )
