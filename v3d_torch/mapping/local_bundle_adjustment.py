"""Local bundle adjustment of a new keyframe, its covisible keyframes and their landmarks (ORB-SLAM2, local mapping)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.config import Config, RollingShutterConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import orthonormalise
from v3d_torch.mapping.bundle_adjustment import bundle_adjust
from v3d_torch.mapping.covisibility import covisible_keyframes
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.map_observations import select_observations
from v3d_torch.mapping.readout_calibration import estimate_readout
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.odometry.rolling_shutter import Readout

_MAX_ITERATIONS = 5
"""Maximum number of Levenberg-Marquardt steps."""

_COST_TOLERANCE = 1e-5
"""Relative change of the cost that ends the optimisation. The cost, the sum of the squared whitened residuals, is some
thousands: the change is far below 1. The adjustment of the next keyframe continues from the result."""

_CALIBRATION_KEYFRAMES, _LATE_CALIBRATION_INTERVAL = 20, 10
"""Number of keyframes at the start that each calibrate the readout, and interval of later keyframes that do so: the
readout is then known well, but a later, faster rotation can improve it."""


@dataclass(frozen=True)
class LocalAdjustment:
    """Result of a local bundle adjustment.

    Attributes:
        T_cw: World-to-camera poses of all keyframes, adjusted or unchanged, float64, shape :math:`(K, 4, 4)`.
        landmarks: Ids of the adjusted landmarks, int64, shape :math:`(P,)`.
        points: Positions of the adjusted landmarks, world frame, metres, float64, shape :math:`(P, 3)`.
        outliers: Rows of the outliers in the table of observations, int64, shape :math:`(O,)`.
        readout: Estimate of the camera's readout after the adjustment.
    """

    T_cw: Tensor
    landmarks: Tensor
    points: Tensor
    outliers: Tensor
    readout: Readout

    def apply(self, sparse_map: SparseMap) -> None:
        """Write the result to the map that was adjusted, in place. No keyframe may have been inserted since.

        Args:
            sparse_map: The map.
        """
        # Landmarks with a single observation are not adjusted: they move with the keyframe that created them.
        sparse_map.move_keyframes(self.T_cw)
        sparse_map.landmarks["point"][self.landmarks] = self.points
        sparse_map.remove_observations(self.outliers)
        if self.readout != sparse_map.readout:
            sparse_map.set_readout(self.readout)


def local_bundle_adjust(
    sparse_map: SparseMap, keyframe: Keyframe, config: Config, camera: PinholeCamera
) -> LocalAdjustment | None:
    """Adjust a new keyframe together with its covisible keyframes and their landmarks, and detect outliers.

    Other keyframes that observe the same landmarks are included with fixed poses.

    Args:
        sparse_map: The map; it is not changed.
        keyframe: The new keyframe.
        config: Configuration of the whole system: size of the window, measurement noise.
        camera: Intrinsics.

    Returns:
        The result, or None if there are fewer than two keyframes or no observations to adjust.
    """
    window = covisible_keyframes(sparse_map, keyframe.observed_landmarks, config.mapping.bundle_keyframes)
    selected = select_observations(sparse_map, window, config, with_neighbours=True)
    if len(window) < 2 or len(selected) == 0:
        return None
    keyframes, landmarks, T_cw = selected.keyframes, selected.landmarks, sparse_map.T_cw
    fixed = ~torch.isin(keyframes, window) | (keyframes == 0)
    if not fixed.any():
        fixed[0] = True  # fix the gauge by the oldest keyframe
    observations = selected.arguments(camera.K, fixed)
    result = bundle_adjust(
        T_cw[keyframes],
        sparse_map.landmarks["point"][landmarks],
        **observations,
        iterations=_MAX_ITERATIONS,
        tolerance=_COST_TOLERANCE,
    )
    readout = sparse_map.readout
    if _is_calibration_due(sparse_map, keyframe, config.rolling_shutter):
        readout_jacobian = sparse_map.observations["readout_jacobian"].index_select(0, selected.rows)
        estimate = estimate_readout(
            readout.seconds,
            readout.information,
            readout_jacobian,
            result.T_cw,
            result.points,
            **observations,
        )
        readout = Readout(*map(float, estimate))
    T_cw[keyframes[~fixed]] = orthonormalise(result.T_cw[~fixed])
    return LocalAdjustment(T_cw, landmarks, result.points, selected.rows[~result.inliers], readout)


def _is_calibration_due(sparse_map: SparseMap, keyframe: Keyframe, config: RollingShutterConfig) -> bool:
    """Check whether the adjustment of a new keyframe calibrates the readout."""
    is_due = keyframe.index <= _CALIBRATION_KEYFRAMES or keyframe.index % _LATE_CALIBRATION_INTERVAL == 0
    return is_due and config.enabled and not sparse_map.readout.is_certain
