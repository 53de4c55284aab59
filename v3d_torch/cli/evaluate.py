"""Command ``v3d-torch evaluate``: errors of a trajectory, compared with the paper's tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import make_app
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runtime.imports import quick_imports

if TYPE_CHECKING:
    from rich.table import Table

    from v3d_torch.evaluation import Evaluation

app = make_app()


@app.command()
@expand_user_paths
def main(
    groundtruth: Annotated[Path, typer.Argument(help="True poses: stamp tx ty tz qx qy qz qw, camera to world.")],
    estimate: Annotated[Path, typer.Argument(help="Estimated poses in the same format, in any world frame.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    max_difference: Annotated[
        float, typer.Option(min=0.0, help="Maximum difference between the timestamps of a pair, seconds.")
    ] = 0.02,
    delta: Annotated[float, typer.Option(min=1e-3, help="Time over which RPE measures drift, seconds.")] = 1.0,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of colour-depth pairs of the sequence, to print the coverage.")
    ] = None,
    sequence: Annotated[
        str | None, typer.Option(help="Sequence of the paper's tables, such as fr3/w/xyz [detected from the paths].")
    ] = None,
) -> None:
    """Evaluate a trajectory by ATE and RPE, as the TUM benchmark does.

    ATE is the absolute error of the aligned positions, RPE the relative error of the motions over a fixed time.
    """
    from dataclasses import replace

    from rich.console import Console

    with quick_imports():
        from v3d_torch.datasets.sequence_names import find_paper_sequence
        from v3d_torch.datasets.tum_extents import describe_estimate_difference
        from v3d_torch.datasets.tum_trajectory import read_groundtruth, read_trajectory
        from v3d_torch.errors import InputError
        from v3d_torch.evaluation import evaluate
        from v3d_torch.evaluation.paper_tables import make_paper_table
        from v3d_torch.runs.print_line import print_line

    with exit_on_error():
        measured, poses = read_groundtruth(groundtruth), read_trajectory(estimate)
        truth, absent = measured.trajectory, () if measured.note is None else (measured.note,)
        if sequence is not None and find_paper_sequence(sequence) is None:
            raise InputError(f"--sequence {sequence}: is not in the paper's tables; use a name such as fr3/w/xyz")
        try:
            evaluation = evaluate(truth, poses, max_time_difference=max_difference, rpe_delta=delta, frames=frames)
        except InputError as error:
            raise InputError(f"{groundtruth}, {estimate}: {error}") from error
        evaluation = replace(evaluation, notes=(*evaluation.notes, *absent))
        if as_json:
            import json

            typer.echo(json.dumps(evaluation.to_dict(), indent=2))
            return
        console = Console(soft_wrap=True, highlight=False)
        console.print(_error_table(evaluation))
        for note in evaluation.notes:
            print_line(console, f"note: {note}")
        texts = (groundtruth.as_posix(), estimate.as_posix()) if sequence is None else (sequence,)
        name = next(filter(None, map(find_paper_sequence, texts)), None)
        if name is not None:
            difference = describe_estimate_difference(name, poses, truth)
            console.print(make_paper_table(name, evaluation, difference))


def _error_table(evaluation: Evaluation) -> Table:
    from dataclasses import astuple, fields

    from rich.table import Table

    from v3d_torch.evaluation.evaluation import format_coverage
    from v3d_torch.evaluation.statistics import Statistics

    coverage = f", {format_coverage(evaluation.coverage)} of the frames" if evaluation.coverage is not None else ""
    rows = {"ATE, m": evaluation.ate}
    if (rpe := evaluation.rpe) is not None:
        delta = "s" if rpe.delta == 1 else f"{rpe.delta:g} s"
        rows |= {f"RPE, m/{delta}": rpe.trans, f"RPE, deg/{delta}": rpe.rot}
    table = Table(title=f"{evaluation.pairs_text}{coverage}")
    table.add_column("error")
    for field in fields(Statistics):
        table.add_column(field.name, justify="right")
    for name, statistics in rows.items():
        table.add_row(name, *(f"{value:.4f}" for value in astuple(statistics)))
    return table
