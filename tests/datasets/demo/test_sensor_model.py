"""Noise and missing measurements of the simulated Kinect."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from v3d_torch.datasets.demo.sensor_model import MAX_DEPTH, grazing_incidence, projector_shadow, simulate_depth
from v3d_torch.datasets.demo.sequence import CAMERA


def test_depth_noise_grows_with_the_square_of_depth() -> None:
    """The standard deviation is about 1.4e-3 z^2 metres (Khoshelham and Elberink), and disparity is quantised."""
    for z in (1.0, 2.0, 3.0, 4.0):
        depth = z * (1.0 + 0.02 * torch.linspace(-1, 1, 640).expand(480, 640))  # a range of many disparity steps
        measured = simulate_depth(depth, CAMERA, torch.Generator().manual_seed(3))
        error = (measured - depth)[measured > 0]
        assert float(error.std()) == pytest.approx(1.4e-3 * z**2, rel=0.05)
        assert abs(float(error.mean())) < 0.5e-3 * z**2
    # Depth is f b * 8 over an integer.
    steps = CAMERA.fx * 0.075 * 8 / measured[measured > 0]
    assert torch.allclose(steps, steps.round(), atol=2e-3)


def test_depth_is_missing_in_projector_shadow_and_out_of_range() -> None:
    depth = torch.full((480, 640), 3.0)
    depth[100:380, 200:400] = 1.5
    shadow = projector_shadow(depth, CAMERA)
    width = CAMERA.fx * 0.075 * (1 / 1.5 - 1 / 3.0)  # disparity between the surfaces: 13 pixels
    assert shadow[240].sum() == pytest.approx(width, abs=2.5)
    assert shadow[240, 200 - int(width) + 3 : 200].all() and not shadow[50].any()
    depth[:, 600:] = MAX_DEPTH + 0.1
    measured = simulate_depth(depth, CAMERA, torch.Generator().manual_seed(0))
    assert (measured[:, 602:] == 0).all()
    assert 0.85 < float((measured > 0).float().mean()) < 0.95


@pytest.mark.parametrize(("degrees", "is_missing"), [(70.0, False), (79.0, False), (81.0, True), (87.0, True)])
def test_grazing_surfaces_have_no_depth(degrees: float, is_missing: bool) -> None:
    """The ray through the principal point meets the plane at the given angle from its normal."""
    slope = np.tan(np.radians(degrees))
    inverse = 1.0 - CAMERA.rays[..., 0] * slope
    mask = grazing_incidence(1.0 / inverse.clamp(min=0.1), CAMERA)[240, 318:322]
    assert bool(mask.all()) is is_missing and bool(mask.any()) is is_missing
