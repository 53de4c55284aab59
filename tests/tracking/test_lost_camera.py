"""Recovery of a lost camera: it is found again, and its poses are flagged meanwhile (benchmarks/lost.py)."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import pytest
import torch
from helpers.long_wall import CAMERA, Slide

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.evaluation.ate import absolute_errors, align
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import TrackingStatus

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import interruptions
import lost

CONFIG = load_config(None, ("segmentation.source=none",))
BEFORE, AFTER = 20, 12
TRACKED, LOST, ODOMETRY = TrackingStatus.TRACKED, TrackingStatus.LOST, TrackingStatus.ODOMETRY
DISCONNECTED = TrackingStatus.DISCONNECTED


@pytest.fixture(scope="module")
def slide() -> Slide:
    """Frames along a wall; the cases play them forwards and backwards, because they need more frames."""
    return Slide(0, 240)


@pytest.fixture(scope="module")
def plain(slide: Slide) -> lost.Result:
    return lost.run_case(slide, interruptions.uninterrupted(len(slide), BEFORE + 150 + AFTER), CONFIG, None)


@pytest.mark.parametrize(
    "case",
    [
        *(make(31, BEFORE, gap, AFTER) for make in (interruptions.covered, interruptions.dropped) for gap in (30, 150)),
        interruptions.elsewhere(31, BEFORE, AFTER),
    ],
    ids=lambda case: case.name,
)
def test_interrupted_camera_is_found_again_and_flags_unreliable_poses(
    slide: Slide, plain: lost.Result, case: interruptions.Case
) -> None:
    result = lost.run_case(slide, case, CONFIG, None)
    scored = lost.score(case, result, plain, slide.T_wc)
    assert scored.recovery is not None and scored.recovery <= 10
    assert scored.unflagged == 0
    assert scored.worst < 0.1
    assert scored.ate <= max(1.5 * scored.reference, 1e-3)
    assert all(result.online[k] is LOST for k, index in enumerate(case.shown) if index == interruptions.COVERED)


def test_part_without_a_loop_stays_disconnected_when_a_loop_joins_a_later_part() -> None:
    """The camera is lost twice, closes a loop from the third part of the map to the first, and returns to the second.

    The parts show columns 0 to 520, 960 to 1440, and 840 to 0 of the wall.
    """
    overrides = ("mapping.restart_after=0.3", "mapping.max_keyframe_interval=4", "loop.min_keyframe_gap=2")
    slam = V3DSLAM(CAMERA, config=load_config(None, ("segmentation.source=none", *overrides)))
    statuses = []
    for path in (Slide(0, 200), Slide(960, 1120), Slide(520, 0), Slide(960, 1120)):
        for index in range(len(path)):
            count = len(slam.poses)
            slam(replace(path[index], index=count, stamp=count / 10))
        statuses.append(slam.poses.status)
    assert statuses == [TRACKED, DISCONNECTED, TRACKED, DISCONNECTED]
    assert slam.loop_closer.loop_count == 1
    parts = [keyframe.part for keyframe in slam.map.keyframes]
    assert [part for part, _ in groupby(parts)] == [0, 1, 0, 1]


def test_camera_that_turns_fast_after_a_gap_is_tracked_as_accurately_as_without(
    real_sequence: Callable[[str], Path],
) -> None:
    """In the first frame after the gap the velocity is unknown, and so is the distortion of the rolling shutter."""
    sequence = load_sequence(str(real_sequence("fr1_rpy")))
    before, gap, after = 60, 150, 12
    case = interruptions.dropped(len(sequence), before, gap, after)
    result = lost.run_case(sequence, case, CONFIG, None)
    truth = lost.true_poses(sequence)[case.shown]
    errors = absolute_errors(truth, result.T_wc, align(truth, result.T_wc))
    assert errors[before:].max() < 0.02  # 0.05 if landmarks were left where the first frame after the gap put them


class TestCases:
    def test_covered_frames_keep_their_times(self) -> None:
        case = interruptions.covered(4, 2, 3, 2)
        assert case.shown == [0, 1, -1, -1, -1, 1, 0] and case.times == case.plain == list(range(7))
        assert (case.cut, case.back) == (2, 5)

    def test_dropped_frames_leave_a_gap_in_time(self) -> None:
        case = interruptions.dropped(4, 2, 3, 2)
        assert case.shown == [0, 1, 1, 0] and case.times == case.plain == [0, 1, 5, 6]
        assert (case.cut, case.back) == (2, 2)

    def test_frames_elsewhere_have_no_uninterrupted_position(self) -> None:
        case = interruptions.elsewhere(100, 2, 3)
        assert case.shown == [0, 1, *range(70, 100), 2, 3, 4] and case.plain == [0, 1, *(30 * [-1]), 2, 3, 4]
        assert (case.cut, case.back) == (2, 32)


def test_scores_of_a_made_up_run_equal_values_by_hand() -> None:
    """Three frames on a triangle, two covered, then three at the second position: lost once, and finally 0.2 m off."""
    case = interruptions.Case("", [0, 1, 2, -1, -1, 1, 1, 1], list(range(8)), list(range(8)), cut=3, back=5)
    truth = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    truth[1, 0, 3], truth[2, 1, 3] = 1.0, 1.0
    T_wc = truth[[0, 1, 2, 2, 2, 1, 1, 1]]
    online = [TRACKED, TRACKED, TRACKED, LOST, TRACKED, LOST, ODOMETRY, TRACKED]
    exact = lost.Result(T_wc, online, online)
    scored = lost.score(case, exact, exact, truth)
    assert scored.recovery == 2 and scored.unflagged == 1 and scored.found == pytest.approx(5 / 6)
    assert scored.worst == pytest.approx(0, abs=1e-12) and not scored.passes
    off = T_wc.clone()
    off[7, 2, 3] += 0.2
    wrong = lost.score(case, lost.Result(off, online, online), exact, truth)
    assert 0.1 < wrong.worst < 0.2 and wrong.ate > 0.05 and wrong.reference == pytest.approx(0, abs=1e-12)
    unknown = torch.cat([truth, torch.full((1, 4, 4), torch.nan)])
    half = replace(case, shown=[0, 1, 2, -1, -1, 1, 3, 3])
    assert lost.score(half, exact, exact, unknown).found == pytest.approx(3 / 4)
    never = lost.recovery(case, 5 * [TRACKED] + 3 * [LOST], truth[[0, 1, 2, 0, 0, 1, 1, 1]])
    assert never == torch.inf


def test_recovery_at_an_unknown_place_is_none() -> None:
    case = interruptions.covered(10, 2, 1, 2)
    far = se3_exp(torch.tensor([[0.0] * 6, [0.1, 0, 0, 0, 0, 0], [9.0, 0, 0, 0, 0, 0]], dtype=torch.float64))
    turned = se3_exp(torch.tensor([[0.0, 0, 0, 0, 0.5, 0]], dtype=torch.float64))
    assert lost.recovery(case, 5 * [LOST], torch.cat([far, far[2:], turned])) is None
