"""The paper's tables: reproduction from published trajectories, agreement with the paper's source, display."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
from helpers.trajectories import noisy, random_walk
from rich.console import Console

from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.evaluation import Evaluation, evaluate
from v3d_torch.evaluation.paper_tables import load_paper_scores, make_paper_table

SEQUENCES = {
    f"fr3/{people[0]}/{motion[:4] if motion == 'halfsphere' else motion}": f"freiburg3_{people}_{motion}"
    for people in ("sitting", "walking")
    for motion in ("xyz", "halfsphere", "static", "rpy")
}
TRANSLATION_ONLY = ("fr3/s/half", "fr3/s/rpy")


def evaluate_published(v3d_data: Path, sequence: str) -> Evaluation:
    """Evaluate the trajectory of V3D-SLAM published by its authors."""
    name = f"rgbd_dataset_{SEQUENCES[sequence]}"
    suffix = "_TRANSLATION_ONLY" if sequence in TRANSLATION_ONLY else ""
    return evaluate(
        read_trajectory(v3d_data / "tum_groundtruth" / f"{name}{suffix}.txt"),
        read_trajectory(v3d_data / "published" / "v3d-slam" / f"Camera_{name}.txt"),
    )


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_published_trajectories_reproduce_the_papers_tables(v3d_data: Path, sequence: str) -> None:
    evaluation = evaluate_published(v3d_data, sequence)
    ate, trans, rot = (load_paper_scores()[metric][sequence]["V3D-SLAM"] for metric in ("ate", "rpe_trans", "rpe_rot"))
    assert (evaluation.ate.rmse, evaluation.ate.std) == pytest.approx(ate, abs=1e-4)
    if sequence in TRANSLATION_ONLY:
        assert evaluation.rpe is None
        return
    assert evaluation.rpe is not None
    assert (evaluation.rpe.trans.rmse, evaluation.rpe.trans.std) == pytest.approx(trans, abs=2e-4)
    assert (evaluation.rpe.rot.rmse, evaluation.rpe.rot.std) == pytest.approx(rot, abs=1e-3)
    assert not evaluation.notes  # even a hand-held camera at rest spans a plane


def test_paper_scores_equal_the_papers_source(v3d_data: Path) -> None:
    source = v3d_data.parent / "paper" / "v3d_slam.tex"
    if not source.is_file():
        pytest.skip(f"the paper's source is missing: {source}")
    tables = re.findall(r"\\begin\{tabular\}.*?\\end\{tabular\}", source.read_text(encoding="utf-8"), re.DOTALL)
    tables = [table for table in tables if "fr3/w/rpy" in table]
    assert len(tables) == 3
    for table, scores in zip(tables, load_paper_scores().values(), strict=True):
        for sequence in SEQUENCES:
            row = re.search(rf"{sequence} &(.*?)\\\\", table, re.DOTALL)
            assert row is not None
            numbers = [None if "--" in cell else float(re.sub(r"\\\w+\{|\}", "", cell)) for cell in row[1].split("&")]
            ours = [value for method, score in scores[sequence].items() for value in score[: 2 - (method == "TRS")]]
            assert ours == numbers


def test_paper_table_compares_result_with_paper() -> None:
    groundtruth = random_walk(60, seed=22)
    evaluation = evaluate(groundtruth, noisy(groundtruth, seed=23, sigma=1e-4))
    table = make_paper_table("rgbd_dataset_freiburg3_walking_xyz", evaluation)
    assert table is not None
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(table)
    text = console.export_text()
    cfp, ours = (next(line for line in text.splitlines() if name in line) for name in ("CFP-SLAM ", "│ this result"))
    assert re.findall(r"[\d.]{6}", cfp) == ["0.0141", "0.0072", "0.0190", "0.0097", "0.6023", "0.3719"]
    assert f"{evaluation.ate.rmse:.4f}" in ours
    assert "deg/s" in text


def test_paper_table_marks_a_part_of_the_sequence_and_no_best_value() -> None:
    groundtruth = random_walk(60, seed=22)
    evaluation = evaluate(groundtruth, noisy(groundtruth, seed=23, sigma=1e-4))
    table = make_paper_table("fr3/w/xyz", evaluation, "part: 60 of 827 frames")
    assert table is not None
    assert list(table.columns[0].cells)[-1] == "this result (part: 60 of 827 frames)"
    assert not any("green" in str(cell) for column in table.columns for cell in column.cells)


def test_paper_table_omits_rpe_over_other_delta() -> None:
    groundtruth = random_walk(90, seed=24)
    table = make_paper_table("fr3/w/xyz", evaluate(groundtruth, noisy(groundtruth, seed=25), rpe_delta=2.0))
    assert table is not None
    assert [list(column.cells)[-1] for column in table.columns[3:]] == ["-"] * 4


def test_paper_scores_have_all_sequences_of_the_paper() -> None:
    assert set(load_paper_scores()["ate"]) == set(SEQUENCES)
