"""Checks of the results of user-defined stages, so that errors name the stage that caused them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import torch
from torch import Tensor

from v3d_torch.errors import ConfigError
from v3d_torch.features.features import Features
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.odometry.odometry import CameraMotion, TrackedFrame
from v3d_torch.runtime.input_checks import INSTANCES, TensorSpec, describe_type, describe_wrong_tensor, fill_in
from v3d_torch.runtime.stage_proxy import STATE_METHODS, CheckingProxy
from v3d_torch.runtime.value_rules import FINITE, HISTOGRAMS, IDS, NOT_NEGATIVE, PAIRS, PIXELS, POSITIVE, RIGID, Rule
from v3d_torch.segmentation.coco import LABELS
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.types import FramePose, Instances, TrackingStatus

_CLASSES = Rule(
    "classes of COCO or -1", lambda values, sizes: bool(((values >= LABELS.start) & (values < LABELS.stop)).all())
)

_FIELDS: Mapping[type, Mapping[str, TensorSpec | type]] = {
    Features: {
        "uv": TensorSpec(torch.float64, ("N", 2), FINITE),
        "pixel": TensorSpec(torch.int64, ("N", 2), PIXELS),
        "depth": TensorSpec(torch.float64, ("N",), NOT_NEGATIVE),
        "octave": TensorSpec(torch.int64, ("N",), NOT_NEGATIVE),
        "descriptors": TensorSpec(torch.uint8, ("N", 32)),
        "readout_jacobian": TensorSpec(torch.float64, ("N", 2), FINITE),
        "sigma_ratio": TensorSpec(torch.float64, ("N", 2), POSITIVE),
    },
    CameraMotion: {
        "T_cp": TensorSpec(torch.float64, (4, 4), RIGID),
        "velocity": TensorSpec(torch.float64, (6,), FINITE),
        "inlier_matches": TensorSpec(torch.int64, ("K", 2), PAIRS),
        "matches": TensorSpec(torch.int64, ("M", 2), PAIRS),
        "is_measured": bool,
    },
    AppearedPixels: {"was_free": TensorSpec(torch.float64, ("B", "h", "w")), "stride": int},
    Instances: {**INSTANCES, "labels": TensorSpec(torch.int64, ("N",), _CLASSES), "track_ids": type(None)},
    InstanceClouds: {
        "points": TensorSpec(torch.float32, ("N", "P", 3)),
        "valid": TensorSpec(torch.bool, ("N", "P")),
        "centroid": TensorSpec(torch.float32, ("N", 3)),
        "cloud_pixels": TensorSpec(torch.bool, ("N", "H", "W")),
    },
    FrameObjects: {
        "objects": list,
        "static_mask": TensorSpec(torch.bool, ("H", "W")),
        "map_mask": TensorSpec(torch.bool, ("H", "W")),
        "vote_pairs": list,
    },
    CameraState: {
        "stamp": float,
        "T_wc": TensorSpec(torch.float64, (4, 4), RIGID),
        "status": TrackingStatus,
        **dict.fromkeys(("covariance", "twist_covariance", "cross_covariance"), TensorSpec(torch.float64, (6, 6))),
        "twist": TensorSpec(torch.float64, (6,), FINITE),
    },
    FramePose: {
        "status": TrackingStatus,
        "T_cw": TensorSpec(torch.float64, (4, 4), RIGID),
        "landmarks": TensorSpec(torch.int64, ("N",), IDS),
        "is_relocalised": bool,
    },
}
"""Fields of each class that a stage returns: dtype, shape and values of tensors, else the type."""


def _image_size(image: Tensor) -> dict[str, int]:
    return dict(zip("HW", image.shape[-2:], strict=True))


def _feature_counts(previous: TrackedFrame | None, current: TrackedFrame) -> dict[str, int]:
    return {"previous": 0 if previous is None else len(previous.features), "current": len(current.features)}


RESULTS: Mapping[str, tuple[type | TensorSpec, Callable[..., dict[str, int]]] | None] = {
    "smooth_depth": (
        TensorSpec(torch.float32, ("B", 1, "H", "W"), NOT_NEGATIVE),
        lambda depth: {"B": len(depth), **_image_size(depth)},
    ),
    "detect_features": (Features, lambda image, depth: _image_size(image)),
    "compensate": (Features, lambda features, depth, *_: {"N": len(features), **_image_size(depth)}),
    "odometry": (CameraMotion, lambda previous, current, *_: _feature_counts(previous, current)),
    "free_space_check": (AppearedPixels, lambda *_: {}),
    "propose_unlabelled": (Instances, lambda appeared_pixels, instances, depth: _image_size(depth)),
    "back_project_instances": (InstanceClouds, lambda depth, instances: {"N": len(instances), **_image_size(depth)}),
    "describe_appearance": (TensorSpec(torch.float32, ("N", "D"), HISTOGRAMS), lambda image, masks: {"N": len(masks)}),
    "classify_motion": (FrameObjects, lambda instances, clouds, view, *_: _image_size(view.depth)),
    "track_camera": (FramePose, lambda features, *_: {"N": len(features)}),
    "estimate_state": (CameraState, lambda *_: {}),
    **dict.fromkeys(("motion_model", "refine_previous", "mapper", "back_end")),
}
"""Expected result of each stage, and a function that returns the sizes given by the stage's arguments; None if the
result is not checked."""


class ReplacedStage(CheckingProxy):
    """Proxy of a user-defined stage that checks types, shapes, dtypes, devices and values of its results.

    Args:
        stage: User-defined stage.
        name: Name of its attribute in `V3DSLAM`.
        replaced: Original stage of that name.
    """

    _OWN = CheckingProxy._OWN | {"_replaced"}

    def __init__(self, stage: Any, name: str, replaced: Any) -> None:
        super().__init__(stage, name)
        self._replaced = replaced

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the stage.

        Raises:
            ConfigError: If the stage lacks a public method of the original stage.
        """
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name.startswith("_") or name in STATE_METHODS or not hasattr(self._replaced, name):
                raise
            raise ConfigError(
                f"{self._name} was replaced by a stage without {name}; derive it from"
                f" {self._replaced.__class__.__name__}"  # which is that of the stage if it is a proxy
            ) from None

    def _check(self, result: Any, *args: Any) -> None:
        checked = RESULTS[self._name]
        if checked is None:
            return
        expected, sizes = checked
        if isinstance(expected, type) and not isinstance(result, expected):
            raise ConfigError(f"{self._name} returned {describe_type(result)}; it must return {expected.__name__}")
        _check_value(self._name, result, expected, sizes(*args))


def _check_value(name: str, value: object, expected: type | TensorSpec, sizes: dict[str, int]) -> None:
    """Check a value, and the fields of a dataclass.

    Args:
        name: Name of the value in messages.
        value: Value.
        expected: Its class, or what a tensor must be.
        sizes: Known sizes by the name of the dimension; sizes that are first seen in the value are added.

    Raises:
        ConfigError: If the value is not as expected.
    """
    if isinstance(expected, type):
        if not isinstance(value, expected):
            raise ConfigError(f"{name} is {describe_type(value)}, expected a {expected.__name__}")
        for field, kind in _FIELDS.get(expected, {}).items():
            _check_value(f"{name}.{field}", getattr(value, field), kind, sizes)
        return
    dtype, dimensions, rule = expected
    shape = fill_in(dimensions, sizes)
    if (wrong := describe_wrong_tensor(value, shape, dtype)) is not None:
        raise ConfigError(f"{name} is {wrong}")
    tensor = cast("Tensor", value)
    sizes |= {name: size for name, size in zip(shape, tensor.shape, strict=True) if isinstance(name, str)}
    if rule is not None and not rule.holds(tensor, sizes):
        raise ConfigError(f"{name} has values that are not {rule.text}")
