"""Local bundle adjustment: a new keyframe, its neighbours and what they see (ORB-SLAM2, local mapping)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.features.features import pixel_sigma
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import orthonormalise
from v3d_torch.mapping.bundle_adjustment import Observations, bundle_adjust
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.readout_calibration import calibrate_readout
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.tensor_table import unique_ids
from v3d_torch.odometry.rolling_shutter import Readout

_SELDOM = 10
"""After the first keyframes every so many ask for the readout: later turns of the camera tell more of it."""


@dataclass(frozen=True)
class LocalAdjustment:
    """What a local bundle adjustment has found.

    Attributes:
        T_cw: world to camera of all keyframes, those adjusted and those left alone, float64, shape :math:`(K, 4, 4)`.
        landmarks: ids of those adjusted, int64, shape :math:`(P,)`.
        points: where they are, world frame, metres, float64, shape :math:`(P, 3)`.
        outliers: rows of the observations that do not fit, int64, shape :math:`(O,)`.
        readout: of the camera, as it is known by now.
    """

    T_cw: Tensor
    landmarks: Tensor
    points: Tensor
    outliers: Tensor
    readout: Readout

    def apply(self, sparse_map: SparseMap) -> None:
        """Change the map that was adjusted, in place; it has got no new keyframe since."""
        # Landmarks with one observation do not take part: they go along with the keyframe that made them.
        sparse_map.move_keyframes(self.T_cw)
        sparse_map.landmarks["point"][self.landmarks] = self.points
        sparse_map.remove_observations(self.outliers)
        if self.readout != sparse_map.readout:
            sparse_map.set_readout(self.readout)


def local_bundle_adjust(
    sparse_map: SparseMap, keyframe: Keyframe, config: Config, camera: PinholeCamera
) -> LocalAdjustment | None:
    """Adjust the keyframes around a new one together with their landmarks, and find what does not fit.

    Keyframes further off that see the same landmarks take part and stay where they are.

    Args:
        sparse_map: stays as it is.
        keyframe: the new one.
        config: size of the neighbourhood, noise.
        camera: intrinsics.

    Returns:
        None where there is nothing to adjust.
    """
    window = sparse_map.covisible_keyframes(
        keyframe.landmarks[keyframe.landmarks >= 0], config.mapping.bundle_keyframes
    )
    table = sparse_map.observations
    rows = _observations_around(sparse_map, window)
    if len(window) < 2 or len(rows) == 0:
        return None
    poses, pose = unique_ids(table["keyframe"][rows], len(sparse_map.keyframes))
    landmarks, point = unique_ids(table["landmark"][rows], len(sparse_map.landmarks))
    T_cw = sparse_map.T_cw
    fixed = ~torch.isin(poses, window) | (poses == 0)
    if not fixed.any():
        fixed[0] = True  # the oldest, else the neighbourhood as a whole could drift
    observations = Observations(
        uv=table["uv"].index_select(0, rows),
        inverse_depth=table["inverse_depth"][rows],
        pixel_sigma=pixel_sigma(table["octave"][rows], config.tracking, config.features),
        inverse_depth_sigma=config.tracking.inverse_depth_sigma,
        pose=pose,
        point=point,
    )
    found = bundle_adjust(
        T_cw[poses],
        sparse_map.landmarks["point"][landmarks],
        observations,
        camera,
        fixed,
        iterations=config.mapping.bundle_iterations,
        tolerance=config.mapping.bundle_tolerance,
    )
    readout = sparse_map.readout
    asks = keyframe.index <= config.rolling_shutter.calibration_keyframes or keyframe.index % _SELDOM == 0
    if asks and config.rolling_shutter.enabled and not readout.is_certain:
        readout = calibrate_readout(readout, *found.errors.profile(table["readout_jacobian"].index_select(0, rows)))
    T_cw[poses[~fixed]] = orthonormalise(found.T_cw[~fixed])
    return LocalAdjustment(T_cw, landmarks, found.points, rows[found.chi2 > observations.chi2_threshold], readout)


def _observations_around(sparse_map: SparseMap, window: Tensor) -> Tensor:
    """Rows of all observations of living landmarks that the window sees and that are seen more than once."""
    table = sparse_map.observations
    usable = table["valid"] & sparse_map.landmarks["alive"][table["landmark"]]
    seen = torch.zeros(len(sparse_map.landmarks), dtype=torch.bool)
    seen[table["landmark"][usable & torch.isin(table["keyframe"], window)]] = True
    times = torch.bincount(table["landmark"][usable], minlength=len(sparse_map.landmarks))
    return torch.nonzero(usable & (seen & (times > 1))[table["landmark"]])[:, 0]
