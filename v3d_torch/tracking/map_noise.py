"""Noise of the map: pose errors of keyframes, which propagate through landmarks to frames and later keyframes.

A landmark has the pose error of the keyframe that created it. A frame that is tracked with landmarks of several
keyframes has the average of their errors; if it becomes a keyframe, its own error is added. For any two keyframes, the
covariance of their errors is stored as one number: a multiple of the covariance of a single frame. The error that a
frame inherits from the map grows as the camera explores, and shrinks when it observes old landmarks again.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.runtime.stateful import StatefulComponent


class MapNoise(StatefulComponent):
    """Covariance of the pose errors of the active keyframes, relative to the variance of a frame."""

    _STATE = ("_rows", "_covariance")

    def __init__(self) -> None:
        self._rows = torch.zeros(0, dtype=torch.int64)  # row of the covariance, for each keyframe
        self._covariance = torch.zeros(0, 0, dtype=torch.float64)

    def __call__(self, owners: Tensor) -> float:
        """Variance of the error that a frame inherits from the map, relative to the variance of a frame.

        Args:
            owners: Indices of the keyframes that created the landmarks of the frame, int64, shape :math:`(L,)`.
        """
        weights = self._weights(owners)
        return float(weights @ self._covariance @ weights)

    def add_keyframe(self, owners: Tensor, references: Tensor, variance: float = 1.0) -> None:
        """Add the newest keyframe. Keyframes culled since the last call get the errors of their reference keyframes.

        Args:
            owners: Indices of the keyframes that created the landmarks with which the new keyframe was tracked, int64,
                shape :math:`(L,)`; empty for the first keyframe, and for a keyframe of unknown pose.
            references: Reference keyframe of each keyframe of the map, see `Keyframe`, int64, shape :math:`(K,)`.
            variance: Variance of the new keyframe's own error, relative to the variance of a frame.
        """
        self._add_unrelated(len(references) - 1)
        weights = self._weights(owners)
        shared = self._covariance @ weights
        own = weights @ shared + variance
        column = torch.cat([shared, own[None]])
        grown = torch.cat([torch.cat([self._covariance, shared[None]]), column[:, None]], dim=1)
        rows = torch.cat([self._rows, torch.tensor([len(shared)])])
        active, self._rows = references.unique(return_inverse=True)
        kept = rows[active]
        self._covariance = grown[kept][:, kept]

    def _add_unrelated(self, count: int) -> None:
        """Add the keyframes of a loaded map, with independent errors, until there are ``count`` keyframes."""
        missing, size = count - len(self._rows), len(self._covariance)
        if missing <= 0:
            return
        self._rows = torch.cat([self._rows, torch.arange(size, size + missing)])
        self._covariance = torch.block_diag(self._covariance, torch.eye(missing, dtype=torch.float64))

    def _weights(self, owners: Tensor) -> Tensor:
        """Fraction of the landmarks that each row of the covariance created, float64; 0 without landmarks."""
        self._add_unrelated(int(owners.max()) + 1 if len(owners) else 0)
        counts = torch.bincount(self._rows[owners], minlength=len(self._covariance)).to(torch.float64)
        return counts / max(len(owners), 1)
