"""``python -m v3d_torch ablate --seq ...``: what each part of the method is worth, the paper's ablation study."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.io.paths import expand_user_paths

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
@expand_user_paths
def main(
    seq: Annotated[list[str], typer.Option(help="demo, a TUM RGB-D sequence or a folder; may be given several times.")],
    data_root: Annotated[
        Path | None, typer.Option(envvar="V3D_DATA", help="Where named sequences are, or are downloaded to.")
    ] = None,
    variants: Annotated[
        str, typer.Option(help="What to run, with commas between.")
    ] = "baseline,no_voting,no_chamfer,no_prediction,no_unlabelled,not_upright,global_shutter,paper,full",
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each variant, with seeds from 0.")] = 3,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="A value for all variants, such as segmentation.model=yolo11n-seg."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [results/ablation/<time>].")] = None,
) -> None:
    """Turn off parts of the system and set the scores side by side."""
    from v3d_torch.batch.study import run_study
    from v3d_torch.runs.console import exit_on_error

    with exit_on_error():
        names = [name.strip() for name in variants.split(",")]
        run_study(seq, names, seeds=seeds, overrides=set_ or [], data_root=data_root, out=out)
