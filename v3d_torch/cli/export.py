"""Command ``v3d-torch export``: images of a finished run with poses and masks, in the formats of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import make_app
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runtime.imports import quick_imports

app = make_app()


@app.command()
@expand_user_paths
def main(
    folder: Annotated[Path, typer.Argument(help="Results of a run with --save-masks: the folder that it printed.")],
    out: Annotated[Path, typer.Option(help="Folder to write; must be new or empty.")],
    format_: Annotated[
        Literal["nerfstudio", "colmap", "tum"],
        typer.Option(
            "--format",
            help="nerfstudio: transforms.json; colmap: text model; tum: TUM layout, depth of moving objects is 0.",
        ),
    ],
    every: Annotated[
        int | None, typer.Option(min=1, help="Every n-th frame [tum: 1; others: as many as give at most 300 images].")
    ] = None,
    keyframes: Annotated[bool, typer.Option("--keyframes", help="Only keyframes.")] = False,
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Remove the lens distortion, for tools that read pinhole images only.")
    ] = False,
    no_masks: Annotated[bool, typer.Option("--no-masks", help="Do not mask moving objects.")] = False,
    seq: Annotated[str | None, typer.Option(help="Sequence of the run, if it was moved.")] = None,
) -> None:
    """Export the images of a run with poses and masks.

    The network does not run again: the masks are those that the run saved.
    """
    from rich.console import Console

    with quick_imports():
        from v3d_torch.cli.export_command import ExportOptions, export_run

    with exit_on_error():
        options = ExportOptions(format_, every, keyframes, undistort, not no_masks)
        export_run(folder, out, options, seq, Console(soft_wrap=True))
