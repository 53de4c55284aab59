"""Checks of the results of user-defined stages, so that errors name the stage that caused them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any, cast

import torch
from torch import Tensor
from torch.utils.hooks import RemovableHandle

from v3d_torch.config import Config
from v3d_torch.errors import ConfigError
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.objects.instance_clouds import InstanceClouds
from v3d_torch.objects.newly_occupied import NewlyOccupied
from v3d_torch.odometry.odometry import CameraMotion, TrackedFrame
from v3d_torch.runtime.input_checks import INSTANCES, TensorSpec, describe_type, describe_wrong_tensor, fill_in
from v3d_torch.runtime.stage_hooks import HookedStage, StageHook, without_hooks
from v3d_torch.runtime.stage_import import make_stage
from v3d_torch.runtime.stage_proxy import STATE_METHODS, CheckingProxy
from v3d_torch.runtime.stateful import Stateful, is_stateful
from v3d_torch.runtime.value_rules import FINITE, HISTOGRAMS, IDS, NOT_NEGATIVE, PAIRS, PIXELS, POSITIVE, RIGID
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.types import FramePose, Instances, TrackingStatus

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
        "pairs": TensorSpec(torch.int64, ("K", 2), PAIRS),
        "is_measured": bool,
    },
    NewlyOccupied: {"appeared": TensorSpec(torch.float64, ("B", "h", "w")), "stride": int},
    Instances: INSTANCES,
    InstanceClouds: {
        "points": TensorSpec(torch.float32, ("N", "P", 3)),
        "valid": TensorSpec(torch.bool, ("N", "P")),
        "centroid": TensorSpec(torch.float32, ("N", 3)),
        "cloud_pixels": TensorSpec(torch.bool, ("N", "H", "W")),
    },
    FrameObjects: {
        "objects": list,
        "static_mask": TensorSpec(torch.bool, ("H", "W")),
        "static_without_people": TensorSpec(torch.bool, ("H", "W")),
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


_RESULTS: Mapping[str, tuple[type | TensorSpec, Callable[..., dict[str, int]]] | None] = {
    "smooth_depth": (
        TensorSpec(torch.float32, ("B", 1, "H", "W"), NOT_NEGATIVE),
        lambda depth: {"B": len(depth), **_image_size(depth)},
    ),
    "detect_features": (Features, lambda image, depth: _image_size(image)),
    "compensate": (Features, lambda features, depth, *_: {"N": len(features), **_image_size(depth)}),
    "odometry": (CameraMotion, lambda previous, current, *_: _feature_counts(previous, current)),
    "free_space_check": (NewlyOccupied, lambda *_: {}),
    "propose_unlabelled": (Instances, lambda occupied, instances, depth: _image_size(depth)),
    "back_project_instances": (InstanceClouds, lambda depth, instances: {"N": len(instances), **_image_size(depth)}),
    "describe_appearance": (TensorSpec(torch.float32, ("N", "D"), HISTOGRAMS), lambda image, masks: {"N": len(masks)}),
    "classify_motion": (FrameObjects, lambda instances, clouds, view, *_: _image_size(view.depth)),
    "track_camera": (FramePose, lambda features, *_: {"N": len(features)}),
    "estimate_state": (CameraState, lambda *_: {}),
    **dict.fromkeys(("motion_model", "refine_previous", "mapper", "back_end")),
}
"""Expected result of each stage, and a function that returns the sizes given by the stage's arguments; None if the
result is not checked."""


_TRAINING_LAYERS = (torch.nn.modules.dropout._DropoutNd, torch.nn.modules.batchnorm._NormBase)
"""Base classes of the layers whose results in training mode depend on chance or on earlier calls."""

_INNER_STAGES = {
    "estimate_motion": "odometry",
    "track_map": "track_camera",
    "loop_closer": "track_camera and back_end",
}
"""Stages that other stages call, and the names of these other stages."""

_SIMILARITY = 0.8
"""Similarity of two names, from 0 to 1, from which one is a misspelling of the other."""

STAGES = ("segment", *(name for name in _RESULTS if name not in ("motion_model", "back_end")))
"""Names of the stages that `V3DSLAM` calls, for hooks. The others have methods only."""


class ReplaceableStages:
    """Base class of `V3DSLAM`: stages are attributes that can be replaced; results of the replacements are checked.

    Hooks see the arguments and results of the stages.
    """

    def __init__(self) -> None:
        self._stage_hooks: OrderedDict[int, tuple[str | None, StageHook]] = OrderedDict()

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute.

        Raises:
            ConfigError: If a stage is set to a value that is not callable, to a class or to a network in training mode,
                if the name is that of no attribute but similar to that of a stage, or if the attribute is used inside
                another stage only, so that its replacement would have no effect.
        """
        if name in _INNER_STAGES and name in vars(self):
            raise ConfigError(
                f"{name} cannot be replaced, because it is used inside {_INNER_STAGES[name]}; replace that instead"
            )
        if not hasattr(self, name) and name not in (*STAGES, *_RESULTS):
            for stage in get_close_matches(name, STAGES, n=1, cutoff=_SIMILARITY):
                raise ConfigError(f"{name} is not a stage; did you mean {stage}?")
        value = without_hooks(value)  # those of this system are added below
        if name in STAGES:
            _check_stage(name, value)
        if name in _RESULTS and name in vars(self):
            value = ReplacedStage(value, name, vars(self)[name])
        previous = vars(self).get(name)
        if isinstance(previous, HookedStage):
            previous._hooks = {}  # the new stage can be a wrapper that calls it; hooks see the wrapper only
            value = HookedStage(value, name, self._stage_hooks)
        super().__setattr__(name, value)

    @property
    def replaced_stages(self) -> list[str]:
        """Names of the stages that were replaced, except the segmenter."""
        return [name for name in _RESULTS if isinstance(without_hooks(vars(self)[name]), ReplacedStage)]

    def register_stage_hook(self, name: str | None, hook: StageHook) -> RemovableHandle:
        """Register a function that is called after each call of a stage, as `torch.nn.Module.register_forward_hook`.

        A hook does not change results: what it returns is ignored, and it must not change tensors in place. Arguments
        and results are not copied; copy what a later stage could change. An error in a hook ends the call of the stage.

        If frames are preprocessed ahead, which is the default in `v3d_torch.pipeline.Pipeline` and `LiveSLAM`, the
        thread "segmentation" calls `segment`, and the thread "features" calls `smooth_depth` and `detect_features`.
        These calls are some frames ahead of those of the other stages, in the thread that calls `track`. Within a
        thread, calls are in the order of the frames.

        Args:
            name: Name of a stage, such as ``odometry``; None for all stages.
            hook: Called with the name of the stage, the arguments of the call in their order, and the result.

        Returns:
            Handle whose method ``remove()`` removes the hook.

        Raises:
            ConfigError: If there is no such stage.
        """
        if name is not None and name not in STAGES:
            raise ConfigError(f"{name}: is not a stage that can have a hook; choose from {', '.join(STAGES)}")
        for each in STAGES if name is None else (name,):
            if not isinstance(stage := vars(self)[each], HookedStage):
                vars(self)[each] = HookedStage(stage, each, self._stage_hooks)
        handle = RemovableHandle(self._stage_hooks)
        self._stage_hooks[handle.id] = name, hook
        return handle

    def _is_changed(self, *names: str) -> bool:
        """Check whether any of these stages was replaced, or has a hook."""
        with_hooks = {name for name, _ in self._stage_hooks.values()}
        return not with_hooks.isdisjoint((None, *names)) or not set(names).isdisjoint(self.replaced_stages)

    def _replace_configured(self, config: Config, camera: PinholeCamera) -> None:
        """Replace the stages for which the configuration has an import path, but the segmenter, see `make_segmenter`.

        Raises:
            ConfigError: If a stage cannot be made, see `make_stage`.
        """
        for name, path in config.stages.paths.items():
            if name != "segment":
                setattr(self, name, make_stage(name, path, config, camera))


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
        checked = _RESULTS[self._name]
        if checked is None:
            return
        expected, sizes = checked
        if isinstance(expected, type) and not isinstance(result, expected):
            raise ConfigError(f"{self._name} returned {describe_type(result)}; it must return {expected.__name__}")
        _check_value(self._name, result, expected, sizes(*args))


def require_state(name: str, component: object) -> Stateful:
    """Return a component, if its state can be saved.

    Args:
        name: Name of its attribute in `V3DSLAM`.
        component: Component, perhaps a user-defined one.

    Raises:
        ConfigError: If it has no ``state_dict`` and ``load_state_dict``.
    """
    if not is_stateful(component):
        raise ConfigError(f"{name} was replaced by a stage without state_dict; its state cannot be saved")
    return cast("Stateful", component)


def _check_stage(name: str, stage: object) -> None:
    """Check that a value can be a stage.

    Args:
        name: Name of its attribute in `V3DSLAM`.
        stage: Value of the attribute.

    Raises:
        ConfigError: If it cannot be called, is a class, or has layers whose results depend on chance or earlier calls.
    """
    if isinstance(stage, type):
        raise ConfigError(f"{name} is the class {stage.__name__}; set an object of this class")
    if not callable(stage):
        raise ConfigError(f"{name} is {describe_type(stage)}, which cannot be called; set a stage")
    layers = stage.modules() if isinstance(stage, torch.nn.Module) else ()
    training = [type(layer).__name__ for layer in layers if isinstance(layer, _TRAINING_LAYERS) and layer.training]
    if training:
        raise ConfigError(
            f"{name} has layers in training mode ({training[0]}), whose results depend on chance or on earlier frames;"
            " call its eval() first"
        )


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
