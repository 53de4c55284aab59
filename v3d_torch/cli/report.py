"""Command ``v3d-torch report``: HTML report of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import make_app
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runtime.imports import quick_imports

app = make_app()


@app.command()
@expand_user_paths
def main(
    folder: Annotated[Path, typer.Argument(help="Results of a run: the folder that the run prints at its end.")],
    groundtruth: Annotated[
        Path | None,
        typer.Option(help="True poses, stamp tx ty tz qx qy qz qw [those of the sequence]."),
    ] = None,
) -> None:
    """Write an HTML report of a run.

    The report is report.html in the folder of the results: one self-contained file for any browser.
    """
    with quick_imports():
        from v3d_torch.io.files import write_text
        from v3d_torch.io.text import printable
        from v3d_torch.runs.report_page import render_page
        from v3d_torch.runs.stored_run import read_run

    with exit_on_error():
        run = read_run(folder, groundtruth)
        write_text(folder / RunFile.REPORT, render_page(run))
        typer.echo(f"report: {printable(folder / RunFile.REPORT)}")
