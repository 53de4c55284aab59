"""Noise of the poses of single frames, estimated from the smoothness of their sequence.

The information matrix of a pose assumes that the errors of its features are independent. They are not: motion blur, the
rolling shutter and errors of depth shift many features together. Residuals do not show such shifts, because the pose
follows them, but the sequence of poses does, because a camera moves smoothly and errors do not. Each pose is compared
with the cubic interpolation of the two poses before and the two after it. The difference counts as noise, also where
the motion changes within a few frames (difference-based variance estimation; Hall, Kay and Titterington, Biometrika
1990).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.runtime.stateful import StatefulComponent

_WINDOW = 5
"""Number of consecutive poses, of which the middle one is compared with the interpolation of the others."""

_MAX_DURATION = 0.6
"""Maximum duration of a window, seconds: five poses of a camera that tracks seven frames per second. The longer the
window, the more of a motion that a cubic polynomial does not describe counts as noise."""

_PRIOR_RATIO = 16.0
"""Ratio of variances that is assumed at the start of a run, when neither the velocity of the camera nor its readout is
known: four times the nominal standard deviation."""

_PRIOR_FRAMES = 2.0
"""Weight of the prior ratio, in frames."""

_MEMORY = 100.0
"""Time constant of the average, in frames: three seconds, over which blur and the number of features change."""

_MIN_RATIO = 1.0
"""Minimum ratio: the errors of a camera at rest are constant, so that its poses seem to have no noise."""


class PoseNoise(StatefulComponent):
    """Ratio of actual to nominal covariance of poses, as a matrix in coordinates whitened by the nominal covariance."""

    _STATE = ("_window", "_sum", "_weight")

    def __init__(self) -> None:
        self._window: list[tuple[float, Tensor, Tensor]] = []  # stamp, T_wc, nominal covariance
        self._sum = _PRIOR_FRAMES * _PRIOR_RATIO * torch.eye(6, dtype=torch.float64)
        self._weight = _PRIOR_FRAMES

    def update(self, stamp: float, T_wc: Tensor, covariance: Tensor) -> None:
        """Append the pose of the next frame.

        Args:
            stamp: Timestamp, seconds.
            T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
            covariance: Nominal covariance of its right perturbation, float64, shape :math:`(6, 6)`.
        """
        self._window = [*self._window[1 - _WINDOW :], (stamp, T_wc, covariance)]
        if len(self._window) < _WINDOW or stamp - self._window[0][0] > _MAX_DURATION:
            return
        stamps, poses, covariances = zip(*self._window, strict=True)
        weights = _interpolation_weights(stamps)
        residual = weights @ se3_log(invert(poses[_WINDOW // 2]) @ torch.stack(poses))
        nominal = (weights.square()[:, None, None] * torch.stack(covariances)).sum(dim=0)
        whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(nominal), residual[:, None], upper=False)
        self._sum = self._sum * (1 - 1 / _MEMORY) + whitened @ whitened.T
        self._weight = self._weight * (1 - 1 / _MEMORY) + 1

    def interrupt(self) -> None:
        """Start a new sequence of poses, after a frame without a pose or a jump of the pose."""
        self._window = []

    def scale(self, covariance: Tensor, *variances: float) -> list[Tensor]:
        """Covariances of a pose with different errors, given its nominal covariance.

        Args:
            covariance: Nominal covariance, float64, shape :math:`(6, 6)`.
            variances: Variances of its error relative to the variance of a frame: 1 for the noise of the frame, more
                with that of the map, see `MapNoise`. Their products with the ratios of the axes are limited.

        Returns:
            A covariance for each variance, float64, shape :math:`(6, 6)`.
        """
        ratios, axes = torch.linalg.eigh(self._sum / self._weight)
        whole = torch.linalg.cholesky(covariance) @ axes
        roots = [whole * (variance * ratios).clamp(min=_MIN_RATIO).sqrt() for variance in variances]
        return [root @ root.T for root in roots]


def _interpolation_weights(stamps: Sequence[float]) -> Tensor:
    """Weights of the poses in the residual: Lagrange weights of the interpolation, and -1 for the middle pose."""
    t, middle = np.array(stamps), len(stamps) // 2  # NumPy is faster than torch for a few numbers
    others = np.delete(t, middle)
    ratios = (t[middle] - others) / (others[:, None] - others + np.eye(len(others)))
    np.fill_diagonal(ratios, 1.0)
    return torch.from_numpy(np.insert(ratios.prod(axis=1), middle, -1.0))
