"""A camera that loses its way finds it again, says so in between, and claims nothing wrong (benchmarks/lost.py)."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.walls import Slide

from v3d_torch.config.loading import load_config
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import TrackingStatus

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import lost

CONFIG = load_config(None, ("segmentation.source=none",))
BEFORE, AFTER = 20, 12
TRACKED, LOST, ODOMETRY = TrackingStatus.TRACKED, TrackingStatus.LOST, TrackingStatus.ODOMETRY


@pytest.fixture(scope="module")
def slide() -> Slide:
    """Along the wall and, as the cases need more frames than there are, back again."""
    return Slide(0, 240)


@pytest.fixture(scope="module")
def plain(slide: Slide) -> lost.Result:
    return lost.follow(slide, lost.uninterrupted(len(slide), BEFORE + 150 + AFTER), CONFIG, None)


@pytest.mark.parametrize(
    "case",
    [
        *(make(31, BEFORE, gap, AFTER) for make in (lost.covered, lost.dropped) for gap in (30, 60, 150)),
        lost.elsewhere(31, BEFORE, AFTER),
    ],
    ids=lambda case: case.name,
)
def test_is_found_again_and_says_what_it_does_not_know(slide: Slide, plain: lost.Result, case: lost.Case) -> None:
    result = lost.follow(slide, case, CONFIG, None)
    scored = lost.score(case, result, plain, slide.T_wc)
    assert scored.recovery is not None and scored.recovery <= 10
    assert scored.unflagged == 0
    assert scored.worst < 0.1
    assert scored.ate <= max(1.5 * scored.reference, 1e-3)
    assert all(result.online[k] is LOST for k, index in enumerate(case.shown) if index == lost.COVERED)


class TestCases:
    def test_covered(self) -> None:
        case = lost.covered(4, 2, 3, 2)
        assert case.shown == [0, 1, -1, -1, -1, 1, 0] and case.beats == case.plain == list(range(7))
        assert (case.cut, case.back) == (2, 5)

    def test_dropped(self) -> None:
        case = lost.dropped(4, 2, 3, 2)
        assert case.shown == [0, 1, 1, 0] and case.beats == case.plain == [0, 1, 5, 6]
        assert (case.cut, case.back) == (2, 2)

    def test_elsewhere(self) -> None:
        case = lost.elsewhere(100, 2, 3)
        assert case.shown == [0, 1, *range(70, 100), 2, 3, 4] and case.plain == [0, 1, *(30 * [-1]), 2, 3, 4]
        assert (case.cut, case.back) == (2, 32)


def test_scores_are_those_of_a_run_made_by_hand() -> None:
    """Three frames on a triangle, two covered, then back at the second: lost once, and then 0.2 m off."""
    case = lost.Case("", [0, 1, 2, -1, -1, 1, 1, 1], list(range(8)), list(range(8)), cut=3, back=5)
    truth = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    truth[1, 0, 3], truth[2, 1, 3] = 1.0, 1.0
    T_wc = truth[[0, 1, 2, 2, 2, 1, 1, 1]]
    online = [TRACKED, TRACKED, TRACKED, LOST, TRACKED, LOST, ODOMETRY, TRACKED]
    exact = lost.Result(T_wc, online, online)
    scored = lost.score(case, exact, exact, truth)
    assert scored.recovery == 2 and scored.unflagged == 1 and scored.found == pytest.approx(5 / 6)
    assert scored.worst == pytest.approx(0, abs=1e-12) and not scored.holds
    off = T_wc.clone()
    off[7, 2, 3] += 0.2
    wrong = lost.score(case, lost.Result(off, online, online), exact, truth)
    assert 0.1 < wrong.worst < 0.2 and wrong.ate > 0.05 and wrong.reference == pytest.approx(0, abs=1e-12)
    unknown = torch.cat([truth, torch.full((1, 4, 4), torch.nan)])
    half = replace(case, shown=[0, 1, 2, -1, -1, 1, 3, 3])
    assert lost.score(half, exact, exact, unknown).found == pytest.approx(3 / 4)
    never = lost.recovery(case, 5 * [TRACKED] + 3 * [LOST], truth[[0, 1, 2, 0, 0, 1, 1, 1]])
    assert never == torch.inf


def test_a_place_that_was_never_seen_is_not_waited_for() -> None:
    case = lost.covered(10, 2, 1, 2)
    far = se3_exp(torch.tensor([[0.0] * 6, [0.1, 0, 0, 0, 0, 0], [9.0, 0, 0, 0, 0, 0]], dtype=torch.float64))
    turned = se3_exp(torch.tensor([[0.0, 0, 0, 0, 0.5, 0]], dtype=torch.float64))
    assert lost.recovery(case, 5 * [LOST], torch.cat([far, far[2:], turned])) is None
