"""``python -m v3d_torch report DIR``: the results of a run as one page to look at."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.io.paths import expand_user_paths

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
@expand_user_paths
def main(
    folder: Annotated[Path, typer.Argument(help="Results of a run: the folder that it names at its end.")],
    groundtruth: Annotated[
        Path | None,
        typer.Option(help="True poses, stamp tx ty tz qx qy qz qw [those that the sequence brought]."),
    ] = None,
) -> None:
    """Make one HTML page of the results of a run.

    It is report.html in their folder: one file with everything in it, for any browser.
    """
    from v3d_torch.io.files import write_text
    from v3d_torch.runs.console import exit_on_error
    from v3d_torch.runs.stored_run import read_run
    from v3d_torch.viz.report_page import render_page

    with exit_on_error():
        run = read_run(folder, groundtruth)
        write_text(folder / "report.html", render_page(run))
        typer.echo(f"report: {folder / 'report.html'}")
