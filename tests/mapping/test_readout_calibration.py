"""Calibration of the readout: weighted mean, limits, and a map of a camera with a rolling shutter."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from helpers.calibration_map import TRUE, make_map
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.geometry.camera import MAX_READOUT, PinholeCamera
from v3d_torch.mapping.local_bundle_adjustment import LocalAdjustment
from v3d_torch.mapping.readout_calibration import calibrate_readout, combine
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout

EXPECTED = Readout(0.02, 0.015**-2)
PINHOLE = replace(TRUE, distortion=(0.0,) * 5)


def derivatives_of(minima: list[float], information: float, at: float = 0.0) -> tuple[Tensor, Tensor]:
    """First and second derivatives of parabolas with given minima and the same information, at a readout."""
    hessian = torch.full((len(minima), 1, 1), 2 * information, dtype=torch.float64)
    return hessian[:, 0] * (at - torch.tensor(minima, dtype=torch.float64)[:, None]), hessian


def make_sparse_map(
    camera: PinholeCamera, keyframes: int, readout: float, *, config: Config | None = None
) -> SparseMap:
    """A map built with the expected readout of the configuration, or that of the camera."""
    sparse_map = SparseMap.empty(config or Config(), camera)
    learned = sparse_map.readout
    tables = make_map(camera, PINHOLE, keyframes=keyframes, readout=readout)
    sparse_map.load_state_dict(tables.state_dict())
    sparse_map.set_readout(learned)
    return sparse_map


def calibrate(sparse_map: SparseMap, config: Config | None = None) -> Readout:
    nothing = LocalAdjustment(sparse_map.T_cw, torch.zeros(0).long(), torch.zeros(0, 3).double(), torch.zeros(0).long())
    return calibrate_readout(sparse_map, nothing, config or Config(), sparse_map.camera)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(0, 0.03), min_size=4, max_size=8), st.floats(-0.04, 0.04))
def test_estimate_is_the_mean_weighted_with_the_information(minima: list[float], at: float) -> None:
    combined = combine(EXPECTED, at, *derivatives_of(minima, 1e5, at))
    information = combined.information - EXPECTED.information
    assert 0 < information <= 1e5 * len(minima) / 4 * (1 + 1e-9)
    mean = sum(minima) / len(minima)
    expected = (EXPECTED.information * EXPECTED.seconds + information * mean) / combined.information
    assert combined.seconds == pytest.approx(expected, abs=1e-9)


def test_contradicting_keyframes_give_a_large_uncertainty() -> None:
    agreeing, contradicting = ([0.01] * 6, [0.0, 0.02] * 3)
    assert combine(EXPECTED, 0.0, *derivatives_of(agreeing, 1e6)).sigma < 1e-3
    assert combine(EXPECTED, 0.0, *derivatives_of(contradicting, 1e6)).sigma > 4e-3


def test_expectation_stays_without_evidence_and_fades_with_it() -> None:
    assert combine(EXPECTED, 0.02, *derivatives_of([0.0] * 6, 0.0)) == EXPECTED
    assert combine(EXPECTED, 0.02, *derivatives_of([0.0] * 3, 1e9)) == EXPECTED  # too few keyframes
    estimates = [
        combine(EXPECTED, 0.02, *derivatives_of([0.0] * 6, information, 0.02)) for information in (1e2, 1e4, 1e6)
    ]
    assert EXPECTED.seconds > estimates[0].seconds > estimates[1].seconds > estimates[2].seconds > 0
    assert EXPECTED.sigma > estimates[0].sigma > estimates[1].sigma > estimates[2].sigma


def test_estimate_is_at_most_the_longest_accepted_readout() -> None:
    assert combine(EXPECTED, 0.0, *derivatives_of([3.0] * 6, 1e9)).seconds == pytest.approx(MAX_READOUT, abs=1e-6)


@pytest.mark.parametrize("readout", [0.0, 0.026])
def test_readout_of_a_camera_is_found_within_its_uncertainty(readout: float) -> None:
    found = calibrate(make_sparse_map(PINHOLE, 16, readout))
    assert found.sigma < 0.003
    assert abs(found.seconds - readout) < 3 * found.sigma


def test_calibration_is_due_when_the_map_has_grown_by_a_third_or_half() -> None:
    counts = range(5, 25)
    due = [count for count in counts if calibrate(make_sparse_map(PINHOLE, count, 0.0)) != EXPECTED]
    assert due == [6, 8, 12, 16, 24]


def test_certain_or_disabled_readout_stays() -> None:
    known = make_sparse_map(replace(PINHOLE, readout=0.01), 16, 0.0)
    assert calibrate(known) == Readout(0.01, math.inf)
    config = load_config(overrides=["rolling_shutter.enabled=false"])
    assert calibrate(make_sparse_map(PINHOLE, 16, 0.02, config=config), config) == GLOBAL_SHUTTER
