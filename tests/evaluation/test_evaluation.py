"""Evaluation of a trajectory: invariance, notes on unusual inputs, missing RPE, errors."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import torch
from helpers.trajectories import assert_statistics, noisy, random_walk
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.evaluation import evaluate
from v3d_torch.evaluation.ate import RotationSource
from v3d_torch.evaluation.evaluation import absent_scores, format_coverage, note_too_few_poses
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory


@given(xi=st.lists(st.floats(-3, 3), min_size=6, max_size=6))
@settings(max_examples=25)
def test_errors_do_not_depend_on_world_frame_of_estimate(xi: list[float]) -> None:
    groundtruth = random_walk(60, seed=3)
    estimate = noisy(groundtruth, seed=4)
    T = se3_exp(torch.tensor(xi, dtype=torch.float64))
    original = evaluate(groundtruth, estimate)
    moved = evaluate(groundtruth, Trajectory(estimate.stamps, T @ estimate.T_wc))
    assert_statistics(moved.ate, vars(original.ate))
    assert original.rpe is not None and moved.rpe is not None
    assert moved.rpe.trans.rmse == pytest.approx(original.rpe.trans.rmse, abs=1e-9)
    assert moved.rpe.rot.rmse == pytest.approx(original.rpe.rot.rmse, abs=1e-9)
    assert torch.allclose(moved.alignment.T_ge @ T, original.alignment.T_ge, atol=1e-9)


@given(scale=st.floats(0.05, 20), seed=st.integers(0, 1000))
@settings(max_examples=40)
def test_wrong_depth_unit_is_noted(scale: float, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randn(60, 6, dtype=torch.float64, generator=generator) * 0.02
    T_wc = torch.eye(4, dtype=torch.float64).repeat(60, 1, 1)
    for i in range(1, 60):
        T_wc[i] = T_wc[i - 1] @ se3_exp(steps[i])
    stamps = torch.arange(60, dtype=torch.float64) / 10
    scaled = T_wc.clone()
    scaled[:, :3, 3] *= scale
    notes = " ".join(evaluate(Trajectory(stamps, T_wc), Trajectory(stamps, scaled)).notes)
    note = re.search(r"is (\S+) times as large as the estimate", notes)
    if 0.7 < scale < 1.4:
        assert note is None
    elif not 0.6 < scale < 1.6:
        assert note is not None and float(note[1]) == pytest.approx(1 / scale, rel=0.01)


@given(seed=st.integers(0, 1000))
@settings(max_examples=40)
def test_estimate_of_other_shape_has_no_depth_unit_note(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    stamps = torch.arange(60, dtype=torch.float64) / 10
    one, other = (se3_exp(torch.randn(60, 6, dtype=torch.float64, generator=generator)) for _ in range(2))
    other[:, :3, 3] *= 5
    assert "times as large" not in " ".join(evaluate(Trajectory(stamps, one), Trajectory(stamps, other)).notes)


def test_lost_poses_do_not_indicate_depth_unit() -> None:
    """The camera is lost in the second half of its path, where the estimate stays at the last known pose."""
    groundtruth = random_walk(60, seed=18)
    groundtruth.T_wc[:, :3, 3] = torch.linspace(0, 1, 60, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0, 0])
    estimate = Trajectory(groundtruth.stamps, groundtruth.T_wc.clone())
    estimate.T_wc[30:, :3, 3] = estimate.T_wc[29, :3, 3]
    is_localised = torch.arange(60) < 30
    assert "times as large" in " ".join(evaluate(groundtruth, estimate).notes)
    evaluation = evaluate(groundtruth, estimate, is_localised=is_localised)
    assert "times as large" not in " ".join(evaluation.notes) and evaluation.ate.rmse > 0.1
    estimate.T_wc[:, :3, 3] /= 5
    assert "is 5 times as large" in " ".join(evaluate(groundtruth, estimate, is_localised=is_localised).notes)
    two = torch.arange(60) < 2
    assert "times as large" not in " ".join(evaluate(groundtruth, estimate, is_localised=two).notes)
    with pytest.raises(InputError, match=r"^is_localised has the type torch\.int64; give a mask of type torch\.bool$"):
        evaluate(groundtruth, estimate, is_localised=is_localised.long())
    with pytest.raises(InputError, match=r"^is_localised has the type list; give a mask of type torch\.bool$"):
        evaluate(groundtruth, estimate, is_localised=is_localised.tolist())  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^is_localised has 59 values for 60 poses; give one for each pose$"):
        evaluate(groundtruth, estimate, is_localised=is_localised[1:])


@pytest.mark.parametrize("name", ["ground truth", "estimate"])
def test_pose_that_is_not_finite_is_an_error(name: str) -> None:
    groundtruth = random_walk(60, seed=13)
    broken = groundtruth.T_wc.clone()
    broken[7, 0, 3] = torch.nan
    pair = {"ground truth": groundtruth.T_wc, "estimate": groundtruth.T_wc} | {name: broken}
    trajectories = [Trajectory(groundtruth.stamps, pair[each]) for each in ("ground truth", "estimate")]
    with pytest.raises(InputError, match=f"^the {name} has a pose that is not finite; remove such poses$"):
        evaluate(*trajectories)


def test_placeholder_orientations_give_no_rpe() -> None:
    groundtruth = random_walk(60, seed=13)
    T_wc = groundtruth.T_wc.clone()
    T_wc[:, :3, :3] = torch.eye(3, dtype=torch.float64)
    evaluation = evaluate(Trajectory(groundtruth.stamps, T_wc), noisy(groundtruth, seed=14))
    assert evaluation.rpe is None and any("placeholders" in note for note in evaluation.notes)
    assert evaluation.ate.rmse == pytest.approx(evaluate(groundtruth, noisy(groundtruth, seed=14)).ate.rmse)


def test_static_camera_has_rpe() -> None:
    """The orientations of a static camera are all the same, but they are not placeholders."""
    stamps = torch.arange(60, dtype=torch.float64) / 30
    groundtruth = Trajectory(stamps, torch.eye(4, dtype=torch.float64).repeat(60, 1, 1))
    evaluation = evaluate(groundtruth, noisy(groundtruth, seed=15, sigma=0.01))
    assert evaluation.rpe is not None and evaluation.rpe.rot.rmse > 0.1
    assert evaluation.alignment.source is RotationSource.ORIENTATIONS


def test_trajectory_shorter_than_delta_has_no_rpe() -> None:
    groundtruth = random_walk(20, seed=16)
    evaluation = evaluate(groundtruth, noisy(groundtruth, seed=17))
    assert evaluation.rpe is None and any("1 s apart" in note for note in evaluation.notes)


def test_fewer_than_three_associated_poses_are_rejected() -> None:
    groundtruth = random_walk(60, seed=18)
    elsewhere = Trajectory(groundtruth.stamps + 100, groundtruth.T_wc)
    empty = Trajectory(groundtruth.stamps[:0], groundtruth.T_wc[:0])
    for estimate in (elsewhere, empty, Trajectory(groundtruth.stamps[:2], groundtruth.T_wc[:2])):
        with pytest.raises(InputError, match="at least 3 are needed; check that both belong to the same sequence"):
            evaluate(groundtruth, estimate)


@pytest.mark.parametrize("difference", [-1.0, float("nan")])
def test_time_difference_that_is_not_at_least_zero_is_rejected(difference: float) -> None:
    groundtruth = random_walk(10, seed=3)
    with pytest.raises(ConfigError, match=f"^max_time_difference is {difference}; give a time of at least 0 seconds$"):
        evaluate(groundtruth, groundtruth, max_time_difference=difference)
    assert evaluate(groundtruth, groundtruth, max_time_difference=0).pairs == 10


def test_negative_number_of_frames_is_rejected() -> None:
    """The coverage was negative."""
    groundtruth = random_walk(10, seed=3)
    with pytest.raises(ConfigError, match=r"^frames is -3; give the number of frames of the sequence$"):
        evaluate(groundtruth, groundtruth, frames=-3)


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_timestamps_in_another_unit_are_named(factor: float, unit: str) -> None:
    seconds = random_walk(60, seed=18)
    counts = Trajectory(seconds.stamps * factor, seconds.T_wc)
    for groundtruth, estimate, name in ((seconds, counts, "estimate"), (counts, seconds, "ground truth")):
        with pytest.raises(InputError, match=f"needed; the timestamps of the {name} seem to be in {unit}, write them"):
            evaluate(groundtruth, estimate)


@pytest.mark.parametrize("origin", [0.0, 1305031229.0])
def test_unit_of_a_short_estimate_is_not_doubted(origin: float) -> None:
    """Of two poses, and of four poses that the ground truth does not have; both last a thousandth of its time."""
    groundtruth = random_walk(1000, seed=18)
    groundtruth = Trajectory(groundtruth.stamps - groundtruth.stamps[0] + origin, groundtruth.T_wc)
    with pytest.raises(InputError, match=r"^only 2 of 2 poses .* and that the estimate is complete$"):
        evaluate(groundtruth, Trajectory(groundtruth.stamps[:2], groundtruth.T_wc[:2]))
    later = groundtruth.stamps[-1] + 1 + torch.arange(4, dtype=torch.float64) / 100
    with pytest.raises(InputError, match=r"check that both belong to the same sequence$"):
        evaluate(groundtruth, Trajectory(later, groundtruth.T_wc[:4]))


@pytest.mark.parametrize(
    ("coverage", "text"),
    [(1.0, "100.0%"), (1 - 1e-6, "99.9%"), (693 / 694, "99.8%"), (0.9, "90.0%"), (0.29, "29.0%"), (0.0, "0.0%")],
)
def test_coverage_is_rounded_down(coverage: float, text: str) -> None:
    assert format_coverage(coverage) == text


def test_coverage_is_the_fraction_of_frames_with_a_pose() -> None:
    groundtruth = random_walk(60, seed=19)
    assert evaluate(groundtruth, groundtruth).coverage is None
    excess = evaluate(groundtruth, groundtruth, frames=59)
    assert excess.coverage == 1 and "60 poses for 59 frames" in excess.notes[-1]


def test_json_has_all_scores() -> None:
    groundtruth = random_walk(60, seed=19)
    evaluation = evaluate(groundtruth, Trajectory(groundtruth.stamps[:45], groundtruth.T_wc[:45]), frames=60)
    assert (evaluation.poses, evaluation.pairs, evaluation.coverage) == (45, 45, 0.75)
    values = json.loads(json.dumps(evaluation.to_dict()))
    assert evaluation.rpe is not None
    assert values["ate"]["rmse"] == evaluation.ate.rmse
    assert values["rpe"]["trans"]["rmse"] == evaluation.rpe.trans.rmse
    assert values["rpe"]["rot"]["std"] == evaluation.rpe.rot.std
    assert absent_scores(45, 60).keys() == values.keys() and absent_scores(45, 60)["coverage"] == 0.75
    assert values["coverage"] == 0.75 and values["alignment"]["rotation_from"] == "positions"


def test_too_few_poses_for_scores_are_noted() -> None:
    groundtruth = random_walk(60, seed=19)
    one, two = (note_too_few_poses(groundtruth, poses) for poses in (1, 2))
    assert one == ("only 1 pose: at least 3 are needed for an ATE",) and two[0].startswith("only 2 poses: at")
    assert note_too_few_poses(groundtruth, 3) == note_too_few_poses(None, 2) == ()
    assert absent_scores(1, 1, one)["notes"] == list(one)


def test_arguments_that_are_not_trajectories_are_rejected() -> None:
    poses = Trajectory(torch.arange(3.0), torch.eye(4).repeat(3, 1, 1))
    with pytest.raises(
        InputError, match=r"^the ground truth is a str, not a Trajectory; read a file with read_trajectory"
    ):
        evaluate("groundtruth.txt", poses)
    with pytest.raises(InputError, match=r"^the estimate is a ndarray, not a Trajectory; read"):
        evaluate(poses, np.zeros((3, 8)))
