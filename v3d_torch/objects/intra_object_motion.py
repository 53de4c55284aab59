"""Intra-object motion: objects that change their shape, even if they stay in place (paper, Sec. III-D)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from v3d_torch.geometry.argument_checks import check_masks, check_not_negative, check_shape
from v3d_torch.geometry.precision import result_dtype, without_autocast, working_dtype
from v3d_torch.geometry.se3 import transform_points
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.objects.chamfer import chamfer_distance


class Deformation(NamedTuple):
    r"""Change of shape of B objects between two times.

    Attributes:
        distance: Root-mean-square nearest-neighbour distance, :math:`\sqrt{D / 2}` with D the Chamfer distance, metres,
            dtype of the clouds, float32 for integers, shape :math:`(B,)`; NaN if one of the two clouds is empty.
        deforming: Mask of the objects whose distance is at least the threshold, bool, shape :math:`(B,)`; False if the
            distance is NaN.
    """

    distance: Tensor
    deforming: Tensor


@without_autocast
def intra_object_motion(
    previous: Tensor,
    current: Tensor,
    distance_threshold: float,
    previous_valid: Tensor | None = None,
    current_valid: Tensor | None = None,
    T_current_previous: Tensor | None = None,
) -> Deformation:
    r"""Compare the cloud of every object with its own cloud at an earlier time.

    The camera moves in between, so both clouds must be expressed in one frame: pass both in the world frame, or each in
    the frame of its own camera together with ``T_current_previous``.

    Args:
        previous: Clouds at the earlier time, metres, shape :math:`(B, N, 3)`.
        current: Clouds of the same objects at the current time, shape :math:`(B, M, 3)`.
        distance_threshold: Minimum distance of a deforming object, metres.
        previous_valid: Mask of the previous points that are not padding, bool, shape :math:`(B, N)`; None for all.
        current_valid: Mask of the current points that are not padding, bool, shape :math:`(B, M)`; None for all.
        T_current_previous: Transform from the frame of ``previous`` to that of ``current``, shape :math:`(B, 4, 4)`, or
            :math:`(4, 4)` for all objects; None if the frames are the same.

    Returns:
        Distance of each object, and the objects that are deforming. The distance is differentiable in clouds and
        transform as `chamfer_distance` is; at a distance of 0, which is a kink, the gradient is set to 0.

    Raises:
        InputError: If a coordinate of a valid point is not finite or exceeds 1e18 m, or if a mask is not bool.
        ConfigError: If ``distance_threshold`` is a number that is negative or NaN.
    """
    check_not_negative(distance_threshold=distance_threshold)
    check_masks(previous_valid=previous_valid, current_valid=current_valid)
    check_shape("previous", previous, "B", "N", 3)
    check_shape("current", current, previous.shape[0], "M", 3)
    dtype = previous.dtype
    previous, current = previous.to(working_dtype(dtype)), current.to(working_dtype(dtype))
    if T_current_previous is not None:
        batch = () if T_current_previous.ndim == 2 else previous.shape[:1]
        check_shape("T_current_previous", T_current_previous, *batch, 4, 4)
        previous = _transform(T_current_previous, previous, previous_valid)
    mean_square = chamfer_distance(previous, current, previous_valid, current_valid) / 2
    # torch.where evaluates both branches: the 1 keeps the gradient of the unused branch finite.
    is_zero = mean_square == 0
    distance = torch.where(is_zero, 0, torch.where(is_zero, 1, mean_square).sqrt())
    return Deformation(distance.to(result_dtype(dtype)), deforming=distance >= distance_threshold)


def _transform(T: Tensor, points: Tensor, valid: Tensor | None) -> Tensor:
    """Transform the valid points by T, and set the padding to the origin, because NaN would reach the gradient of T."""
    if valid is not None:
        points = torch.where(valid[..., None], points, 0)
    return transform_points(T, points)


class IntraObjectMotion(SettingsModule):
    """:func:`intra_object_motion` as a module.

    Args:
        distance_threshold: Minimum distance of a deforming object, metres.

    Raises:
        ConfigError: If a number is not possible; see :func:`intra_object_motion`.
    """

    def __init__(self, distance_threshold: float) -> None:
        check_not_negative(distance_threshold=distance_threshold)
        super().__init__()
        self.distance_threshold = distance_threshold

    def forward(
        self,
        previous: Tensor,
        current: Tensor,
        previous_valid: Tensor | None = None,
        current_valid: Tensor | None = None,
        T_current_previous: Tensor | None = None,
    ) -> Deformation:
        """Compare clouds, metres, shape :math:`(B, N, 3)` and :math:`(B, M, 3)`; see :func:`intra_object_motion`."""
        return intra_object_motion(
            previous, current, self.distance_threshold, previous_valid, current_valid, T_current_previous
        )
