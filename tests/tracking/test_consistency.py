"""Consistency of the covariance of poses with their errors (benchmarks/consistency.py)."""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest
import torch
from scipy.stats import chi2

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.segmentation import make_segmenter
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Trajectory

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import consistency


@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_nees_of_simulated_errors_is_that_of_the_chi_square_distribution(noise: float) -> None:
    """World, mounting and clock of the ground truth are unknown, and do not count as errors, nor does its noise."""
    generator = torch.Generator().manual_seed(0)

    def swing(stamps: torch.Tensor) -> torch.Tensor:
        amplitude = torch.tensor([0.3, 0.2, 0.3, 0.4, 0.5, 0.3], dtype=torch.float64)
        phase = torch.arange(6, dtype=torch.float64)
        return se3_exp(amplitude * torch.sin(1.3 * stamps[:, None] + phase))

    T_gw, T_cb = se3_exp(torch.randn(2, 6, dtype=torch.float64, generator=generator)[:, None])[:, 0]
    true_stamps, stamps = (
        torch.arange(2000, dtype=torch.float64) / 100,
        0.2 + torch.arange(550, dtype=torch.float64) / 30,
    )
    jitter = noise * torch.randn(2000, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    groundtruth = Trajectory(true_stamps + 0.03, T_gw @ swing(true_stamps) @ T_cb @ se3_exp(jitter))
    sigmas = consistency.groundtruth_noise(groundtruth)
    torch.testing.assert_close(sigmas, torch.full_like(sigmas, noise), rtol=0.2, atol=1e-5)
    roots = torch.tensor([0.01] * 3 + [0.005] * 3, dtype=torch.float64) * (
        torch.eye(6, dtype=torch.float64) + 0.3 * torch.randn(550, 6, 6, dtype=torch.float64, generator=generator)
    )
    errors = (roots @ torch.randn(550, 6, 1, dtype=torch.float64, generator=generator))[..., 0]
    estimate = swing(stamps) @ se3_exp(-errors)
    nees = consistency.calibrated_errors(groundtruth, stamps, estimate, roots @ roots.mT).nees(slice(0, 6))
    assert abs(float(nees.mean()) - 6) < 3 * (12 / 550) ** 0.5
    assert 0.92 < float((nees < chi2.ppf(0.95, 6)).double().mean()) < 0.98
    low, high = consistency.mean_bounds(nees)
    assert low < float(nees.mean()) < high
    for bound, probability in ((low, 0.025), (high, 0.975)):
        assert abs(bound - chi2.ppf(probability, 6 * 550) / 550) < 0.2


def test_bounds_of_the_mean_are_wider_if_errors_last_for_many_frames() -> None:
    """Each error lasts for 20 poses: there are as many independent errors as in a run of a twentieth."""
    generator = torch.Generator().manual_seed(0)
    errors = torch.randn(300, 6, dtype=torch.float64, generator=generator)
    low, high = consistency.mean_bounds(errors.square().sum(dim=1).repeat_interleave(20))
    expected = [chi2.ppf(probability, 6 * 300) / 300 for probability in (0.025, 0.975)]
    assert abs(low - expected[0]) < 0.2 and abs(high - expected[1]) < 0.2


def test_noise_of_poses_at_the_rate_of_a_camera_is_not_measured() -> None:
    stamps = torch.arange(100, dtype=torch.float64) / 30
    poses = se3_exp(0.01 * torch.randn(100, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    assert not consistency.groundtruth_noise(Trajectory(stamps, poses)).any()


def test_covariance_on_recorded_images_is_not_overconfident(real_sequence: Callable[[str], Path]) -> None:
    """A second and a half of a rotating camera, with true masks, for position and rotation.

    The mean NEES is below the upper bound of consistent poses. It has a rough lower bound only, because the calibration
    of the ground truth fits 13 numbers to the errors of this short part.
    """
    folder = real_sequence("crowd_rpy")
    sequence = load_sequence(str(folder))
    assert sequence.groundtruth is not None
    config = load_config(overrides=["segmentation.source=masks"])
    segment = make_segmenter(config, sequence.camera, masks_dir=folder / "masks")
    slam = V3DSLAM(sequence.camera, segment, config)
    states = [slam(frame) for frame in islice(sequence, 45)]
    errors = consistency.calibrated_errors(
        sequence.groundtruth,
        sequence.stamps[:45],
        torch.stack([state.T_wc for state in states]),
        torch.stack([state.covariance for state in states]),
    )
    for dimensions in (slice(0, 3), slice(3, 6)):
        nees = errors.nees(dimensions)
        _, high = consistency.mean_bounds(2 * nees)  # bounds of six dimensions
        assert 1.0 < float(nees.mean()) < high / 2
        assert float((nees < chi2.ppf(0.95, 3)).double().mean()) > 0.8
