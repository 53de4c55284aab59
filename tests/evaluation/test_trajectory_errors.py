"""The evaluation against evo, against the rules of the benchmark's tools, and against the paper's own tables."""

from __future__ import annotations

import copy
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.evaluation import Evaluation, evaluate
from v3d_torch.evaluation.association import match
from v3d_torch.evaluation.ate import RotationSource, absolute_errors, align, scale_error, spans_plane
from v3d_torch.evaluation.paper_tables import paper_scores, paper_sequence, paper_table
from v3d_torch.evaluation.rpe import drift, pairs_apart, relative_errors, relative_pose_error
from v3d_torch.evaluation.statistics import Statistics
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.types import Trajectory

SEQUENCES = {
    f"fr3/{people[0]}/{motion[:4] if motion == 'halfsphere' else motion}": f"freiburg3_{people}_{motion}"
    for people in ("sitting", "walking")
    for motion in ("xyz", "halfsphere", "static", "rpy")
}
TRANSLATION_ONLY = ("fr3/s/half", "fr3/s/rpy")


def walk(poses: int, seed: int, rate: float = 30.0, step: float = 0.05) -> Trajectory:
    """A random walk, evenly spaced in time."""
    generator = torch.Generator().manual_seed(seed)
    steps = se3_exp(step * torch.randn(poses, 6, dtype=torch.float64, generator=generator))
    T_wc = [se3_exp(torch.randn(6, dtype=torch.float64, generator=generator))]
    for motion in steps[1:]:
        T_wc.append(T_wc[-1] @ motion)
    return Trajectory(1000 + torch.arange(poses, dtype=torch.float64) / rate, torch.stack(T_wc))


def noisy(trajectory: Trajectory, seed: int, sigma: float = 0.02) -> Trajectory:
    """The same motion with errors, seen from another world."""
    generator = torch.Generator().manual_seed(seed)
    noise = se3_exp(sigma * torch.randn(len(trajectory), 6, dtype=torch.float64, generator=generator))
    T_ew = se3_exp(torch.randn(6, dtype=torch.float64, generator=generator))
    return Trajectory(trajectory.stamps, T_ew @ trajectory.T_wc @ noise)


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.T_wc.numpy()), timestamps=trajectory.stamps.numpy())


def assert_statistics(ours: Statistics, theirs: dict[str, float]) -> None:
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(ours, name) == pytest.approx(theirs[name], abs=1e-9), name


@pytest.mark.parametrize("seed", range(5))
def test_ate_is_evos(seed: int) -> None:
    groundtruth = walk(200, seed)
    estimate = noisy(groundtruth, seed + 100)
    reference, aligned = as_evo(groundtruth), copy.deepcopy(as_evo(estimate))
    R, t, _ = aligned.align(reference)
    theirs = metrics.APE(metrics.PoseRelation.translation_part)
    theirs.process_data((reference, aligned))
    evaluation = evaluate(groundtruth, estimate)
    assert_statistics(evaluation.ate, theirs.get_all_statistics())
    np.testing.assert_allclose(evaluation.alignment.T_ge[:3, :3].numpy(), R, atol=1e-9)
    np.testing.assert_allclose(evaluation.alignment.T_ge[:3, 3].numpy(), t, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_rpe_is_evos(seed: int) -> None:
    """The benchmark's tool puts the true motion's inverse on the right, evo on the left: the same for time reversed.

    Of evo's pairs those that end in the last pose are not the tool's.
    """
    groundtruth = walk(120, seed)
    estimate = noisy(groundtruth, seed + 100)
    backwards = [
        PoseTrajectory3D(poses_se3=list(t.T_wc[:-1].flip(0).numpy()), timestamps=t.stamps[:-1].numpy())
        for t in (groundtruth, estimate)
    ]
    rpe = evaluate(groundtruth, estimate).rpe
    assert rpe is not None and rpe.pairs == 120 - 1 - 30
    for ours, relation in (
        (rpe.trans, metrics.PoseRelation.translation_part),
        (rpe.rot, metrics.PoseRelation.rotation_angle_deg),
    ):
        theirs = metrics.RPE(relation, delta=30, delta_unit=metrics.Unit.frames, all_pairs=True)
        theirs.process_data(tuple(backwards))
        assert_statistics(ours, theirs.get_all_statistics())


def test_rpe_pairs_are_those_of_the_benchmarks_tool() -> None:
    """For uneven stamps: the nearest to one second later, the last pose never; written out as a plain loop."""
    generator = np.random.default_rng(5)
    stamps = np.cumsum(generator.uniform(0.02, 0.12, 150))
    expected = []
    for i, stamp in enumerate(stamps):
        j = min(range(len(stamps)), key=lambda k: abs(stamps[k] - (stamp + 1.0)))
        if j != len(stamps) - 1:
            expected.append((i, j))
    first, second = pairs_apart(torch.from_numpy(stamps), 1.0)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == expected


@pytest.mark.parametrize(("second", "pairs"), [(0.5, [(0, 1)]), (0.625, [(0, 1)]), (0.4375, [])])
def test_convention_a_pair_may_be_off_by_half(second: float, pairs: list[tuple[int, int]]) -> None:
    stamps = torch.tensor([0.0, second, 5.0, 10.0], dtype=torch.float64)
    assert list(zip(*(poses.tolist() for poses in pairs_apart(stamps, 1.0)), strict=True)) == pairs


def test_drift_is_measured_over_a_second_unless_told_otherwise() -> None:
    groundtruth = walk(90, seed=16)
    estimate = noisy(groundtruth, seed=17)
    matches = match(groundtruth, estimate)
    by_default = relative_pose_error(groundtruth, estimate, matches)
    assert by_default is not None and by_default.delta == 1.0
    assert by_default == relative_pose_error(groundtruth, estimate, matches, 1.0)
    over_two = relative_pose_error(groundtruth, estimate, matches, 2.0)
    assert over_two is not None and over_two.delta == 2.0 and over_two.pairs == by_default.pairs - 30
    single = drift(groundtruth, estimate, matches)
    assert single.first.tolist() == list(range(by_default.pairs))
    assert Statistics.of(single.trans) == by_default.trans and Statistics.of(single.rot) == by_default.rot
    assert relative_pose_error(groundtruth, estimate, matches, 10.0) is None


def test_drift_of_poses_without_truth_is_not_measured() -> None:
    """Truth for the poses from the tenth on, in a row of its own: indices of the two are not the same."""
    groundtruth = walk(60, seed=18)
    estimate = noisy(groundtruth, seed=19)
    late = Trajectory(groundtruth.stamps[10:], groundtruth.T_wc[10:])
    found = drift(late, estimate, match(late, estimate), 0.5)
    everywhere = drift(groundtruth, estimate, match(groundtruth, estimate), 0.5)
    assert found.first.tolist() == [first for first in everywhere.first.tolist() if first >= 10]
    torch.testing.assert_close(found.trans, everywhere.trans[10:])


def test_no_rpe_across_a_gap() -> None:
    """With nothing a second later there is no pair: neither a pose with itself, nor one three seconds on."""
    stamps = torch.cat([torch.arange(0, 1.05, 0.1), torch.arange(5, 8.05, 0.1)]).double()
    first, second = pairs_apart(stamps, 1.0)
    assert len(first) > 20
    assert ((stamps[second] - stamps[first] - 1).abs() <= 0.5).all()
    assert not (first == second).any()


@given(seed=st.integers(0, 1000))
@settings(max_examples=30)
def test_association_is_one_to_one_nearest_first(seed: int) -> None:
    """Against the rule of the benchmark's associate.py, written out as a plain loop."""
    generator = np.random.default_rng(seed)
    a, b = (np.unique(generator.uniform(0, 1, 40).round(3)) for _ in range(2))
    candidates = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) < 0.0205)
    expected, used_a, used_b = [], set(), set()
    for _, i, j in candidates:
        if i not in used_a and j not in used_b:
            expected.append((i, j))
            used_a.add(i)
            used_b.add(j)
    estimate, groundtruth = (Trajectory(torch.from_numpy(s), torch.eye(4).expand(len(s), 4, 4)) for s in (a, b))
    matches = match(groundtruth, estimate, 0.0205)
    assert list(zip(matches.estimate.tolist(), matches.groundtruth.tolist(), strict=True)) == sorted(expected)


@given(xi=st.lists(st.floats(-3, 3), min_size=6, max_size=6))
@settings(max_examples=25)
def test_errors_do_not_depend_on_the_estimates_world(xi: list[float]) -> None:
    groundtruth = walk(60, seed=3)
    estimate = noisy(groundtruth, seed=4)
    T = se3_exp(torch.tensor(xi, dtype=torch.float64))
    here = evaluate(groundtruth, estimate)
    there = evaluate(groundtruth, Trajectory(estimate.stamps, T @ estimate.T_wc))
    assert_statistics(there.ate, vars(here.ate))
    assert here.rpe is not None and there.rpe is not None
    assert there.rpe.trans.rmse == pytest.approx(here.rpe.trans.rmse, abs=1e-9)
    assert there.rpe.rot.rmse == pytest.approx(here.rpe.rot.rmse, abs=1e-9)
    assert torch.allclose(there.alignment.T_ge @ T, here.alignment.T_ge, atol=1e-9)


@given(scale=st.floats(0.05, 20), seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_a_wrong_unit_of_depth_is_noted(scale: float, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randn(60, 6, dtype=torch.float64, generator=generator) * 0.02
    T_wc = torch.eye(4, dtype=torch.float64).repeat(60, 1, 1)
    for i in range(1, 60):
        T_wc[i] = T_wc[i - 1] @ se3_exp(steps[i])
    stamps = torch.arange(60, dtype=torch.float64) / 10
    small = T_wc.clone()
    small[:, :3, 3] *= scale
    notes = " ".join(evaluate(Trajectory(stamps, T_wc), Trajectory(stamps, small)).notes)
    said = re.search(r"is (\S+) times as large as the estimate", notes)
    if 0.7 < scale < 1.4:
        assert said is None
    elif not 0.6 < scale < 1.6:
        assert said is not None and float(said[1]) == pytest.approx(1 / scale, rel=0.01)


@given(seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_an_estimate_of_another_shape_has_no_wrong_unit(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    stamps = torch.arange(60, dtype=torch.float64) / 10
    one, other = (se3_exp(torch.randn(60, 6, dtype=torch.float64, generator=generator)) for _ in range(2))
    other[:, :3, 3] *= 5
    assert "times as large" not in " ".join(evaluate(Trajectory(stamps, one), Trajectory(stamps, other)).notes)


def test_convention_alignment_maps_the_estimate_to_the_ground_truth() -> None:
    groundtruth = walk(50, seed=6)
    estimate = noisy(groundtruth, seed=7, sigma=0.0)
    evaluation = evaluate(groundtruth, estimate)
    assert torch.allclose(evaluation.alignment.T_ge @ estimate.T_wc, groundtruth.T_wc, atol=1e-12)
    assert evaluation.ate.max < 1e-12
    assert evaluation.alignment.source is RotationSource.POSITIONS and not evaluation.notes


def test_scale_is_not_corrected() -> None:
    groundtruth = walk(50, seed=6)
    T_wc = groundtruth.T_wc.clone()
    T_wc[:, :3, 3] *= 1.1
    p = groundtruth.T_wc[:, :3, 3]
    spread = (p - p.mean(dim=0)).square().sum(dim=1).mean().sqrt().item()
    assert evaluate(groundtruth, Trajectory(groundtruth.stamps, T_wc)).ate.rmse == pytest.approx(0.1 * spread)


def test_a_mirrored_estimate_is_turned_not_mirrored() -> None:
    groundtruth = walk(50, seed=8)
    T_wc = groundtruth.T_wc.clone()
    T_wc[:, 0, 3] *= -1
    evaluation = evaluate(groundtruth, Trajectory(groundtruth.stamps, T_wc))
    assert torch.linalg.det(evaluation.alignment.T_ge).item() == pytest.approx(1)
    assert evaluation.ate.rmse > 0.01


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (1.0, 2.0, -1.0)])
def test_positions_on_a_point_or_a_line_are_aligned_by_orientations(direction: tuple[float, float, float]) -> None:
    """A camera that only turns, or moves on a line: the true rotation is found, that of positions alone is not it."""
    groundtruth = walk(90, seed=9)
    on_line = torch.linspace(0, 1, 90, dtype=torch.float64)[:, None] * torch.tensor(direction, dtype=torch.float64)
    T_wc = groundtruth.T_wc.clone()
    T_wc[:, :3, 3] = on_line
    groundtruth = Trajectory(groundtruth.stamps, T_wc)
    estimate = noisy(groundtruth, seed=10, sigma=1e-3)
    evaluation = evaluate(groundtruth, estimate)
    assert evaluation.alignment.source is RotationSource.ORIENTATIONS
    assert any("span no plane" in note for note in evaluation.notes)
    misaligned = Rotation.from_matrix((evaluation.alignment.T_ge @ estimate.T_wc @ invert(T_wc))[:, :3, :3].numpy())
    assert misaligned.magnitude().mean() < 5e-3
    by_positions = align(T_wc, estimate.T_wc, oriented=False)
    misaligned = Rotation.from_matrix((by_positions.T_ge @ estimate.T_wc @ invert(T_wc))[:, :3, :3].numpy())
    assert misaligned.magnitude().mean() > 0.1
    aligned = (evaluation.alignment.T_ge @ estimate.T_wc)[:, :3, 3]
    assert torch.allclose(aligned.mean(dim=0), T_wc[:, :3, 3].mean(dim=0), atol=1e-12)


@pytest.mark.parametrize("count", [4, 400])
def test_convention_a_plane_is_spanned_by_a_millimetre(count: int) -> None:
    """Standard deviations along the axes; the least of the three says nothing."""
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)
    corners = corners.repeat(count // 4, 1) + 5
    for spread, plane in (([1, 1.01e-3, 0], True), ([1, 0.99e-3, 0.99e-3], False), ([0, 1.01e-3, 1.01e-3], True)):
        assert spans_plane(corners * torch.tensor(spread, dtype=torch.float64)) is plane


@pytest.mark.parametrize(("size", "told"), [(1.49, False), (1.51, True), (1 / 1.49, False), (1 / 1.51, True)])
def test_convention_another_unit_is_half_as_much_again(size: float, told: bool) -> None:
    truth = walk(40, seed=20).T_wc
    estimate = truth.clone()
    estimate[:, :3, 3] /= size
    found = scale_error(truth, estimate, align(truth, estimate))
    assert found == (pytest.approx(size) if told else None)


def test_an_estimate_with_half_the_spread_in_another_shape_has_no_wrong_unit() -> None:
    """What is left of the truth's spread, once the size is right: noise of so many times the signal."""
    truth = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    truth[:, 0, 3] = torch.tensor([1.0, -1, 1, -1])
    for noise, told in ((0.55, True), (0.6, False)):  # left is noise^2 / (1 + noise^2), a quarter at 0.577
        estimate = truth.clone()
        estimate[:, 1, 3] = noise * torch.tensor([1.0, 1, -1, -1])
        estimate[:, :3, 3] /= 3
        alignment = replace(align(truth, truth), T_ge=torch.eye(4, dtype=torch.float64))
        assert (scale_error(truth, estimate, alignment) is not None) is told


def test_mean_of_orientations_is_scipys() -> None:
    groundtruth = walk(40, seed=11)
    groundtruth.T_wc[:, :3, 3] = 0
    estimate = noisy(groundtruth, seed=12, sigma=0.3)
    between = groundtruth.T_wc[:, :3, :3] @ estimate.T_wc[:, :3, :3].mT
    expected = Rotation.from_matrix(between.numpy()).mean().as_matrix()
    np.testing.assert_allclose(align(groundtruth.T_wc, estimate.T_wc).T_ge[:3, :3].numpy(), expected, atol=1e-9)


def test_placeholder_orientations_give_no_rpe() -> None:
    groundtruth = walk(60, seed=13)
    T_wc = groundtruth.T_wc.clone()
    T_wc[:, :3, :3] = torch.eye(3, dtype=torch.float64)
    evaluation = evaluate(Trajectory(groundtruth.stamps, T_wc), noisy(groundtruth, seed=14))
    assert evaluation.rpe is None and any("placeholders" in note for note in evaluation.notes)
    assert evaluation.ate.rmse == pytest.approx(evaluate(groundtruth, noisy(groundtruth, seed=14)).ate.rmse)


def test_a_camera_that_stands_still_has_an_rpe() -> None:
    """Its orientations are all the same because it does not turn."""
    stamps = torch.arange(60, dtype=torch.float64) / 30
    groundtruth = Trajectory(stamps, torch.eye(4, dtype=torch.float64).repeat(60, 1, 1))
    evaluation = evaluate(groundtruth, noisy(groundtruth, seed=15, sigma=0.01))
    assert evaluation.rpe is not None and evaluation.rpe.rot.rmse > 0.1
    assert evaluation.alignment.source is RotationSource.ORIENTATIONS


def test_a_trajectory_shorter_than_the_delta_has_no_rpe() -> None:
    groundtruth = walk(20, seed=16)
    evaluation = evaluate(groundtruth, noisy(groundtruth, seed=17))
    assert evaluation.rpe is None and any("1 s apart" in note for note in evaluation.notes)


def test_too_few_poses_in_common_are_refused() -> None:
    groundtruth = walk(60, seed=18)
    elsewhere = Trajectory(groundtruth.stamps + 100, groundtruth.T_wc)
    empty = Trajectory(groundtruth.stamps[:0], groundtruth.T_wc[:0])
    for estimate in (elsewhere, empty, Trajectory(groundtruth.stamps[:2], groundtruth.T_wc[:2])):
        with pytest.raises(InputError, match="at least 3 are needed"):
            evaluate(groundtruth, estimate)


def test_coverage_and_plain_values() -> None:
    groundtruth = walk(60, seed=19)
    evaluation = evaluate(groundtruth, Trajectory(groundtruth.stamps[:45], groundtruth.T_wc[:45]), frames=60)
    assert (evaluation.poses, evaluation.pairs, evaluation.coverage) == (45, 45, 0.75)
    assert evaluate(groundtruth, groundtruth).coverage is None
    values = json.loads(json.dumps(evaluation.to_dict()))
    assert evaluation.rpe is not None
    assert values["ate"]["rmse"] == evaluation.ate.rmse
    assert values["rpe"]["trans"]["rmse"] == evaluation.rpe.trans.rmse
    assert values["rpe"]["rot"]["std"] == evaluation.rpe.rot.std
    assert values["coverage"] == 0.75 and values["alignment"]["rotation_from"] == "positions"


@pytest.mark.parametrize("what", ["absolute", "relative"])
def test_errors_are_differentiable(what: str) -> None:
    groundtruth = walk(6, seed=20, step=0.3).T_wc
    start = noisy(walk(6, seed=20, step=0.3), seed=21, sigma=0.1).T_wc

    def errors(xi: Tensor) -> Tensor:
        T_ec = start @ se3_exp(xi)
        if what == "absolute":
            return absolute_errors(groundtruth, T_ec, align(groundtruth, T_ec))
        return torch.cat(relative_errors(groundtruth[:-1], groundtruth[1:], T_ec[:-1], T_ec[1:]))

    assert torch.autograd.gradcheck(errors, torch.zeros(6, 6, dtype=torch.float64, requires_grad=True))


def published(v3d_data: Path, sequence: str) -> Evaluation:
    """V3D-SLAM's own trajectory, as its authors published it."""
    name = f"rgbd_dataset_{SEQUENCES[sequence]}"
    suffix = "_TRANSLATION_ONLY" if sequence in TRANSLATION_ONLY else ""
    return evaluate(
        read_trajectory(v3d_data / "tum_groundtruth" / f"{name}{suffix}.txt"),
        read_trajectory(v3d_data / "published" / "v3d-slam" / f"Camera_{name}.txt"),
    )


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_the_papers_tables_are_reproduced(v3d_data: Path, sequence: str) -> None:
    evaluation = published(v3d_data, sequence)
    ate, trans, rot = (paper_scores()[metric][sequence]["V3D-SLAM"] for metric in ("ate", "rpe_trans", "rpe_rot"))
    assert (evaluation.ate.rmse, evaluation.ate.std) == pytest.approx(ate, abs=2e-4)
    if sequence in TRANSLATION_ONLY:
        assert evaluation.rpe is None
        return
    assert evaluation.rpe is not None
    assert (evaluation.rpe.trans.rmse, evaluation.rpe.trans.std) == pytest.approx(trans, abs=2e-4)
    assert (evaluation.rpe.rot.rmse, evaluation.rpe.rot.std) == pytest.approx(rot, abs=1e-3)
    assert not evaluation.notes  # even the hand that holds the camera still spans a plane


def test_paper_tables_are_those_of_the_paper(v3d_data: Path) -> None:
    source = v3d_data.parent / "paper" / "v3d_slam.tex"
    if not source.is_file():
        pytest.skip(f"the paper's source is not there: {source}")
    tables = re.findall(r"\\begin\{tabular\}.*?\\end\{tabular\}", source.read_text(encoding="utf-8"), re.DOTALL)
    tables = [table for table in tables if "fr3/w/rpy" in table]
    assert len(tables) == 3
    for table, scores in zip(tables, paper_scores().values(), strict=True):
        for sequence in SEQUENCES:
            row = re.search(rf"{sequence} &(.*?)\\\\", table, re.DOTALL)
            assert row is not None
            numbers = [None if "--" in cell else float(re.sub(r"\\\w+\{|\}", "", cell)) for cell in row[1].split("&")]
            ours = [value for method, score in scores[sequence].items() for value in score[: 2 - (method == "TRS")]]
            assert ours == numbers


def test_a_result_beside_the_papers_rows() -> None:
    groundtruth = walk(60, seed=22)
    evaluation = evaluate(groundtruth, noisy(groundtruth, seed=23, sigma=1e-4))
    table = paper_table("rgbd_dataset_freiburg3_walking_xyz", evaluation)
    assert table is not None
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(table)
    text = console.export_text()
    cfp, ours = (next(line for line in text.splitlines() if name in line) for name in ("CFP-SLAM ", "│ this result"))
    assert re.findall(r"[\d.]{6}", cfp) == ["0.0141", "0.0072", "0.0190", "0.0097", "0.6023", "0.3719"]
    assert f"{evaluation.ate.rmse:.4f}" in ours
    assert "deg/s" in text


def test_an_rpe_over_another_time_is_not_set_beside_the_papers() -> None:
    groundtruth = walk(90, seed=24)
    table = paper_table("fr3/w/xyz", evaluate(groundtruth, noisy(groundtruth, seed=25), rpe_delta=2.0))
    assert table is not None
    assert [list(column.cells)[-1] for column in table.columns[3:]] == ["-"] * 4


@pytest.mark.parametrize(
    ("name", "sequence"),
    [
        ("fr3/w/xyz", "fr3/w/xyz"),
        ("walking_half", "fr3/w/half"),
        ("fr3_sit_static.txt", "fr3/s/static"),
        ("results/fr3_w_rpy/latest/trajectory.txt", "fr3/w/rpy"),
        ("rgbd_dataset_freiburg3_sitting_rpy_TRANSLATION_ONLY.txt", "fr3/s/rpy"),
        ("data/rgbd_dataset_freiburg3_walking_halfsphere/groundtruth.txt", "fr3/w/half"),
        ("rgbd_dataset_freiburg3_walking_xyz_validation/groundtruth.txt", None),
        ("fr3_w_xyz/fr3_s_xyz.txt", None),
        ("fr1_rpy", None),
        ("demo", None),
    ],
)
def test_sequences_of_the_paper_by_name(name: str, sequence: str | None) -> None:
    assert paper_sequence(name) == sequence
    assert set(paper_scores()["ate"]) == set(SEQUENCES)


def test_what_is_no_trajectory_is_said() -> None:
    poses = Trajectory(torch.arange(3.0), torch.eye(4).repeat(3, 1, 1))
    with pytest.raises(InputError, match=r"^the ground truth is a str; give a Trajectory: of a file by read"):
        evaluate("groundtruth.txt", poses)
    with pytest.raises(InputError, match=r"^the estimate is a ndarray; give a Trajectory"):
        evaluate(poses, np.zeros((3, 8)))
