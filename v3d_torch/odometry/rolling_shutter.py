"""Rolling-shutter compensation: the rows of an image are read one after the other while the camera moves.

Features are moved to where they would have been observed at the time of the middle row (cf. Hedborg et al., Rolling
Shutter Bundle Adjustment, CVPR 2012). The shift of a feature is its readout Jacobian times the readout: the readout is
the time from the first to the last row, and the readout Jacobian is the motion field times the feature's row, from -1/2
to 1/2, with opposite sign. An unknown readout is calibrated while mapping.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from v3d_torch.config import RollingShutterConfig
from v3d_torch.errors import ConfigError
from v3d_torch.features.features import Features
from v3d_torch.geometry.argument_checks import check_masks
from v3d_torch.geometry.camera import MAX_READOUT, PinholeCamera
from v3d_torch.geometry.motion_field import motion_field
from v3d_torch.geometry.precision import result_dtype
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import time_compensation as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.runtime.batches import check_shapes, fill_padding

_MIN_HEIGHT = 2
"""Minimum number of rows: the readout is the time from the first to the last row."""


@dataclass(frozen=True)
class Readout:
    """Estimate of the readout, the time that a camera takes to read the rows of its colour image.

    Attributes:
        seconds: Time from the first to the last row, seconds; 0 for a global shutter, negative if the rows are read
            from the bottom up.
        information: Inverse variance of ``seconds``, 1/s^2; infinite if the readout is known exactly.
    """

    seconds: float
    information: float

    @property
    def is_certain(self) -> bool:
        """True if the readout is known exactly and needs no calibration."""
        return math.isinf(self.information)

    @property
    def sigma(self) -> float:
        """Standard deviation of ``seconds``, seconds; 0 if the readout is known exactly."""
        return self.information**-0.5

    @classmethod
    def from_camera(cls, camera: PinholeCamera, config: RollingShutterConfig) -> Readout:
        """The camera's readout if it is known, else the expected one; 0 if the compensation is disabled.

        Args:
            camera: Camera, with or without a readout.
            config: Expected readout and its standard deviation, and whether it is used.
        """
        if not config.enabled:
            return GLOBAL_SHUTTER
        if camera.readout is not None:
            return cls(camera.readout, math.inf)
        return cls(config.readout, config.readout_sigma**-2)

    def for_new_run(self, initial: Readout) -> Readout:
        """Return the initial readout of a run that loads a map, given this readout of the map.

        Args:
            initial: Readout with which the run would start without a map.
        """
        if initial.is_certain:
            return initial
        return Readout(self.seconds, initial.information) if self.is_certain else self

    @classmethod
    def from_dict(cls, attributes: Mapping[str, float]) -> Readout:
        """Create a readout from its attributes by name.

        Args:
            attributes: ``seconds`` and ``information``.

        Raises:
            ValueError: If the readout is out of range or not a number.
        """
        seconds, information = float(attributes["seconds"]), float(attributes["information"])
        if not (abs(seconds) <= MAX_READOUT and information > 0):
            raise ValueError(f"the readout is {seconds} s; expected at most {MAX_READOUT} s")
        return cls(seconds, information)


GLOBAL_SHUTTER = Readout(0.0, math.inf)
"""Readout of a camera that reads all rows at once."""


def _compensate_compiled(
    uv: Tensor,
    row: Tensor,
    inverse_depth: Tensor,
    velocity: Tensor,
    readout: Tensor | float,
    K: Tensor,
    height: int,
    readout_jacobian: Tensor | None = None,
    valid: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    if isinstance(readout, Tensor) or readout_jacobian is None or valid is not None or height < _MIN_HEIGHT:
        return NotImplemented
    # The kernel does not check what it reads.
    is_single = (
        uv.shape == readout_jacobian.shape == (len(row), 2)
        and row.shape == inverse_depth.shape == uv.shape[:1]
        and velocity.shape == (6,)
        and K.shape == (3, 3)
    )
    if not is_single or any(each.dtype != torch.float64 for each in (uv, inverse_depth, velocity, K, readout_jacobian)):
        return NotImplemented
    new_uv, new_jacobian = kernels.compensate_rolling_shutter(
        to_array(uv),
        to_array(row.to(torch.float64)),
        to_array(inverse_depth),
        to_array(velocity),
        to_array(K),
        to_array(readout_jacobian),
        readout,
        height,
    )
    return torch.from_numpy(new_uv), torch.from_numpy(new_jacobian)


@compiled_by(_compensate_compiled)
def compensate_rolling_shutter(
    uv: Tensor,
    row: Tensor,
    inverse_depth: Tensor,
    velocity: Tensor,
    readout: Tensor | float,
    K: Tensor,
    height: int,
    readout_jacobian: Tensor | None = None,
    valid: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Move pixels to where a moving rolling-shutter camera would have observed them at the time of the middle row.

    .. math::
        u' = u + \tau j, \qquad j = - \left( \frac{v}{H - 1} - \frac{1}{2} \right) \dot u

    with the readout :math:`\tau`, the row :math:`v` of an image of :math:`H` rows, and the motion field :math:`\dot u`
    (Longuet-Higgins and Prazdny, 1980). Differentiable in all floating-point inputs.

    Hedborg et al., Rolling Shutter Bundle Adjustment, CVPR 2012.

    Args:
        uv: Undistorted pixels, as observed or compensated with ``readout_jacobian``, floating point, shape
            :math:`(*, N, 2)`. All inputs are converted to float64.
        row: Row of each pixel in the recorded image, shape :math:`(*, N)`.
        inverse_depth: Inverse depth of each pixel, 1/m, shape :math:`(*, N)`; 0 = not measured. A pixel without depth
            is treated as infinitely far.
        velocity: Twist ``[m/s, rad/s]`` by which static points move in the camera frame, shape
            :math:`(*, 6)`: ``T_cw`` becomes ``exp(velocity * dt) @ T_cw``.
        readout: Time from the first to the last row, seconds, a number or shape :math:`(*)`; negative if the rows are
            read from the bottom up.
        K: Camera matrix, shape :math:`(*, 3, 3)`.
        height: Number of rows of the image, at least 2.
        readout_jacobian: Readout Jacobian with which ``uv`` was compensated before, for the same readout and another
            velocity; that compensation is replaced. None if ``uv`` was not compensated.
        valid: Mask of the pixels that are not padding, bool, shape :math:`(*, N)`; None for all.

    Returns:
        Pixels, and their derivatives with respect to the readout (pixels per second), both with the dtype of ``uv``,
        float32 for integers, and of shape :math:`(*, N, 2)`; 0 for padding.

    Raises:
        InputError: If ``valid`` is not bool.
        ConfigError: If ``height`` is less than 2.
    """
    check_masks(valid=valid)
    _check_height(height)
    check_shapes(
        uv=(uv, "N", 2),
        row=(row, "N"),
        inverse_depth=(inverse_depth, "N"),
        velocity=(velocity, 6),
        readout=(readout,),
        K=(K, 3, 3),
        readout_jacobian=(readout_jacobian, "N", 2),
        valid=(valid, "N"),
    )
    seconds = torch.as_tensor(readout, dtype=torch.float64, device=uv.device)[..., None, None]
    each = None if valid is None else valid[..., None]
    observed = fill_padding(uv, each, 0.0)
    if readout_jacobian is not None:
        observed = observed - seconds * fill_padding(readout_jacobian, each, 0.0)
    row, inverse_depth = fill_padding(row, valid, 0.0), fill_padding(inverse_depth, valid, 0.0)
    pixel_velocity, _ = motion_field(observed, inverse_depth, velocity.to(torch.float64), K.to(torch.float64))
    jacobian = -(row / (height - 1) - 0.5)[..., None] * pixel_velocity  # rows from -0.5 to 0.5
    compensated = observed + seconds * jacobian
    # The readout can be the only input with batch dimensions.
    jacobian = jacobian.expand_as(compensated).contiguous()
    dtype = result_dtype(uv.dtype)
    return fill_padding(compensated, each, 0.0).to(dtype), fill_padding(jacobian, each, 0.0).to(dtype)


def _check_height(height: int) -> None:
    if height < _MIN_HEIGHT:
        raise ConfigError(f"height is {height}; give at least {_MIN_HEIGHT} rows")


def compensate_features(features: Features, velocity: Tensor, readout: Readout, camera: PinholeCamera) -> Features:
    """Compensate the rolling shutter for the features of a frame; see `compensate_rolling_shutter`.

    Args:
        features: Features as observed, or compensated with the same readout and another velocity.
        velocity: Twist ``[m/s, rad/s]`` by which static points move in the camera frame, float64, shape
            :math:`(6,)`.
        readout: Readout of the camera.
        camera: Camera that observed the features.

    Returns:
        The features with ``uv`` and ``readout_jacobian`` for this velocity.
    """
    uv, readout_jacobian = compensate_rolling_shutter(
        features.uv,
        features.pixel[:, 1],
        features.inverse_depth,
        velocity,
        readout.seconds,
        camera.K,
        camera.height,
        features.readout_jacobian,
    )
    return replace(features, uv=uv, readout_jacobian=readout_jacobian)


def undo_compensation(features: Features, readout: Readout) -> Features:
    """Return the features where they were observed, the inverse of `compensate_features` with the same readout."""
    uv = features.uv - readout.seconds * features.readout_jacobian
    return replace(features, uv=uv, readout_jacobian=torch.zeros_like(uv))


class RollingShutterCompensation(SettingsModule):
    """:func:`compensate_rolling_shutter` as a module. A readout given as a `torch.nn.Parameter` can be learned.

    Args:
        readout: Time from the first to the last row, seconds.
        height: Number of rows of the image.

    Raises:
        ConfigError: If a number is not possible; see :func:`compensate_rolling_shutter`.
    """

    def __init__(self, readout: Tensor | float, height: int) -> None:
        _check_height(height)
        super().__init__()
        self.readout = readout
        self.height = height

    def forward(
        self,
        uv: Tensor,
        row: Tensor,
        inverse_depth: Tensor,
        velocity: Tensor,
        K: Tensor,
        readout_jacobian: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Compensate pixels :math:`(*, N, 2)` for a velocity :math:`(*, 6)`.

        See :func:`compensate_rolling_shutter`.
        """
        return compensate_rolling_shutter(
            uv, row, inverse_depth, velocity, self.readout, K, self.height, readout_jacobian, valid
        )
