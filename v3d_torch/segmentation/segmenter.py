"""Segmenters that use the predicted pose of the camera, and the state of segmenters."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, Protocol, cast, runtime_checkable

import torch
from torch import Tensor, nn

from v3d_torch.errors import ConfigError, V3DError
from v3d_torch.io.text import describe_error
from v3d_torch.runtime.input_checks import describe_type
from v3d_torch.runtime.stateful import Stateful, has_methods, is_stateful
from v3d_torch.types import Instances, RGBDFrame, Segmenter


@runtime_checkable
class PoseAwareSegmenter(Protocol):
    """A segmenter that uses the predicted pose of the camera, for example to rotate images upright."""

    def segment_with_pose(self, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
        """Find the instances in the colour image of a frame.

        Args:
            frame: Frame.
            T_cw: Predicted world-to-camera pose, float64, shape :math:`(4, 4)`; None if it is not known.
        """


def segment_frame(segmenter: Segmenter, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
    """Segment a frame; only a `PoseAwareSegmenter` receives the predicted pose.

    Args:
        segmenter: Segmenter.
        frame: Frame.
        T_cw: Predicted world-to-camera pose, float64, shape :math:`(4, 4)`; None if it is not known.
    """
    if has_methods(segmenter, "segment_with_pose"):
        return cast("PoseAwareSegmenter", segmenter).segment_with_pose(frame, T_cw)
    return segmenter(frame)


def without_empty_masks(instances: Instances) -> Instances:
    """Leave out instances without pixels: they have no position, so that each would become an object of one frame.

    Args:
        instances: Instances of a frame.

    Returns:
        The other instances; ``instances`` itself if every mask has pixels.
    """
    has_pixels = instances.masks.numpy().any(axis=(1, 2))  # NumPy is several times as fast here as torch
    return instances[torch.from_numpy(has_pixels)]


def innermost_segmenter(segmenter: Segmenter) -> Segmenter:
    """Return the segmenter inside all wrappers; the attribute ``wrapped`` of a wrapper is the segmenter inside it."""
    while (wrapped := getattr(segmenter, "wrapped", None)) is not None:
        segmenter = wrapped
    return segmenter


def segmenter_state_of(segmenter: object) -> dict[str, Any] | None:
    """Return a copy of the state of a segmenter; None if it has no state.

    It is a copy because frames are segmented ahead of tracking, and a state can share its objects with the segmenter.

    A torch module counts as stateless: its state_dict holds its weights, which are constant and too large to copy in
    each frame.
    """
    has_state = is_stateful(segmenter) and not isinstance(segmenter, nn.Module)
    return copy.deepcopy(cast("Stateful", segmenter).state_dict()) if has_state else None


def restore_segmenter(segmenter: object, state: Mapping[str, Any] | None) -> None:
    """Restore a state that `segmenter_state_of` returned; do nothing if it is None.

    Raises:
        ConfigError: If the segmenter cannot load the state, for example because it is that of another segmenter.
    """
    if state is None or not is_stateful(segmenter):
        return
    try:
        cast("Stateful", segmenter).load_state_dict(copy.deepcopy(state))
    except V3DError:
        raise
    except Exception as error:  # a segmenter runs any code
        raise ConfigError(
            f"the segmenter, {describe_type(segmenter)}, cannot load the saved state ({describe_error(error)}); give"
            " the segmenter with which the state was saved"
        ) from error
