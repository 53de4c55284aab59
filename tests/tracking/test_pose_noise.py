"""Noise of single poses from their sequence, and noise of the map from the ancestry of keyframes."""

from __future__ import annotations

import pytest
import torch

from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.tracking.map_noise import MapNoise
from v3d_torch.tracking.pose_noise import PoseNoise

NOMINAL = torch.tensor([0.001] * 3 + [0.0005] * 3, dtype=torch.float64).square().diag()


def ids(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.int64)


@pytest.mark.parametrize("factor", [1.0, 4.0])
@pytest.mark.parametrize("rate", [60, 30, 10, 7])
def test_noise_of_a_smooth_motion_is_measured(factor: float, rate: int) -> None:
    """The camera swings within some seconds; its poses have ``factor`` times the nominal standard deviation."""
    generator = torch.Generator().manual_seed(0)
    amplitude = torch.tensor([0.2, 0.1, 0.1, 0.2, 0.3, 0.1], dtype=torch.float64)
    noise = PoseNoise()
    for n in range(300):
        error = factor * NOMINAL.sqrt() @ torch.randn(6, dtype=torch.float64, generator=generator)
        swing = torch.sin(torch.tensor(min(30 / rate, 1.0) * n / 15))
        noise.update(n / rate, se3_exp(amplitude * swing) @ se3_exp(error), NOMINAL)
    ratios = (noise.scale(NOMINAL, 1.0)[0] / NOMINAL).diagonal()
    assert 0.6 * factor**2 < ratios.min() and ratios.max() < 1.7 * factor**2


def test_camera_at_rest_has_at_least_the_nominal_noise() -> None:
    noise = PoseNoise()
    for n in range(500):
        noise.update(n / 30, torch.eye(4, dtype=torch.float64), NOMINAL)
    for scaled in noise.scale(NOMINAL, 1.0, 3.0):  # the map has no more noise than its frames
        torch.testing.assert_close(scaled, NOMINAL)


def test_noise_of_the_map_multiplies_that_of_a_frame() -> None:
    noise = PoseNoise()  # the prior ratio is far above the minimum
    frame, whole = noise.scale(NOMINAL, 1.0, 3.0)
    torch.testing.assert_close(whole, 3 * frame)
    assert torch.equal(whole, noise.scale(NOMINAL, 3.0)[0]) and noise.scale(NOMINAL) == []


def test_windows_over_interruptions_do_not_count() -> None:
    noise = PoseNoise()
    before = noise.scale(NOMINAL, 1.0)[0]
    for n in range(40):
        if n % 4 == 0:
            noise.interrupt()
        noise.update(n / 30, se3_exp(torch.full((6,), 0.5 * (n % 2), dtype=torch.float64)), NOMINAL)
    for n in range(40):  # one frame a second
        noise.update(10.0 + n, se3_exp(torch.full((6,), 0.5 * (n % 2), dtype=torch.float64)), NOMINAL)
    for n in range(40):  # five frames last for 0.67 s
        noise.update(100.0 + n / 6, se3_exp(torch.full((6,), 0.5 * (n % 2), dtype=torch.float64)), NOMINAL)
    assert torch.equal(noise.scale(NOMINAL, 1.0)[0], before)


def test_error_of_the_map_grows_along_a_chain_of_keyframes() -> None:
    """Each keyframe observes only landmarks of the one before, and adds the noise of one frame."""
    noise = MapNoise()
    noise.add_keyframe(ids(), ids(0), variance=0.0)
    for n in range(1, 6):
        noise.add_keyframe(ids(n - 1, n - 1), torch.arange(n + 1))
        assert noise(ids(n)) == pytest.approx(n)
    assert noise(ids(0)) == 0  # a frame that sees the first landmarks again
    assert noise(ids(0, 4)) == pytest.approx(1.0)  # half of the error of the fourth
    assert noise(ids()) == 0


def test_culled_keyframe_takes_the_error_of_its_reference() -> None:
    noise = MapNoise()
    noise.add_keyframe(ids(), ids(0), variance=0.0)
    for n in range(1, 4):
        noise.add_keyframe(ids(n - 1), torch.arange(n + 1))
    noise.add_keyframe(ids(3), ids(0, 0, 3, 3, 4))
    assert [noise(ids(n)) for n in range(5)] == pytest.approx([0, 0, 3, 3, 4])
    assert noise.state_dict()["covariance"].shape == (3, 3)  # one row per keyframe that is left


def test_keyframes_of_a_loaded_map_have_independent_errors() -> None:
    noise = MapNoise()
    assert noise(ids(0, 1, 2, 3)) == pytest.approx(1 / 4)
