"""The paper's tables I-III as data, and a table that compares a result with them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import yaml
from rich.table import Table

from v3d_torch.datasets.sequence_names import find_paper_sequence
from v3d_torch.evaluation.evaluation import Evaluation
from v3d_torch.evaluation.outcome import label_sequence


class Score(NamedTuple):
    """RMSE and standard deviation of an error in the paper's tables; None if the paper prints a dash."""

    rmse: float | None
    sd: float | None


HEADINGS = {"ate": "ATE, m", "rpe_trans": "RPE, m/s", "rpe_rot": "RPE, deg/s"}
"""Heading of each metric of the paper's tables, with its unit."""

_RESULT = "this result"


@cache
def load_paper_scores() -> Mapping[str, Mapping[str, Mapping[str, Score]]]:
    """Return the numbers of the paper's tables as ``[metric][sequence][method]``.

    Metrics are ``ate`` (metres), ``rpe_trans`` (metres over 1 s) and ``rpe_rot`` (degrees over 1 s), sequences
    ``fr3/s/xyz`` to ``fr3/w/rpy``, methods ``ORB-SLAM2`` to ``V3D-SLAM``.
    """
    tables = yaml.safe_load(files(__package__).joinpath("paper_tables.yaml").read_text(encoding="utf-8"))
    return {
        metric: {
            sequence: {method: Score(*scores) for method, scores in row.items()} for sequence, row in table.items()
        }
        for metric, table in tables.items()
    }


def make_paper_table(sequence: str, evaluation: Evaluation, difference: str | None = None) -> Table | None:
    """Return a table of the paper's methods and a result on the same sequence, the best RMSE of each column in green.

    Args:
        sequence: Name of the sequence, in any notation accepted by `find_paper_sequence`.
        evaluation: Evaluation of the result.
        difference: Difference between the sequence and that of the paper, which is shown beside the result, and no
            value is marked as the best; None if there is none.

    Returns:
        The table; None if the paper does not evaluate the sequence.
    """
    name = find_paper_sequence(sequence)
    if name is None:
        return None
    scores = load_paper_scores()
    rows = {method: [scores[metric][name][method] for metric in HEADINGS] for method in scores["ate"][name]}
    result = label_sequence(_RESULT, difference)
    rows[result] = _scores(evaluation)
    best = [
        min(score.rmse for score in column if score.rmse is not None) if difference is None else None
        for column in zip(*rows.values(), strict=True)
    ]

    table = Table(title=f"{name}: the paper's tables and this result")
    table.add_column("method")
    for heading in HEADINGS.values():
        table.add_column(f"{heading} RMSE", justify="right")
        table.add_column("SD", justify="right")
    for method, row in rows.items():
        cells = [cell for score, lowest in zip(row, best, strict=True) for cell in _cells(score, lowest)]
        table.add_row(method, *cells, style="bold" if method == result else None)
    return table


def _scores(evaluation: Evaluation) -> list[Score]:
    """Return a result in the columns of the paper. The RPE is omitted unless it is over one second, as in the paper."""
    rpe = evaluation.rpe if evaluation.rpe is not None and evaluation.rpe.delta == 1 else None
    measured = [evaluation.ate, rpe.trans if rpe else None, rpe.rot if rpe else None]
    return [Score(s.rmse, s.std) if s is not None else Score(None, None) for s in measured]


def _cells(score: Score, lowest: float | None) -> tuple[str, str]:
    rmse, sd = ("-" if value is None else f"{value:.4f}" for value in score)
    return (f"[green]{rmse}[/]" if score.rmse == lowest and lowest is not None else rmse), sd
