"""Stages of the system as attributes that users can replace, and hooks that see their results."""

from __future__ import annotations

from collections import OrderedDict
from difflib import get_close_matches
from typing import Any, cast

import torch
from torch.utils.hooks import RemovableHandle

from v3d_torch.config import Config
from v3d_torch.errors import ConfigError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.runtime.input_checks import describe_type
from v3d_torch.runtime.stage_hooks import HookedStage, StageHook, without_hooks
from v3d_torch.runtime.stage_import import make_stage
from v3d_torch.runtime.stateful import Stateful, is_stateful
from v3d_torch.stages.stage_checks import RESULTS, ReplacedStage

_TRAINING_LAYERS = (torch.nn.modules.dropout._DropoutNd, torch.nn.modules.batchnorm._NormBase)
"""Base classes of the layers whose results in training mode depend on chance or on earlier calls."""

INNER_STAGES = {
    "estimate_motion": "odometry",
    "track_map": "track_camera",
    "loop_closer": "track_camera and back_end",
}
"""Stages that other stages call, and the names of these other stages."""

_SIMILARITY = 0.8
"""Similarity of two names, from 0 to 1, from which one is a misspelling of the other."""

STAGES = ("segment", *(name for name in RESULTS if name not in ("motion_model", "back_end")))
"""Names of the stages that can have hooks. Of `motion_model` and `back_end`, `V3DSLAM` calls methods only."""


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
        if name in INNER_STAGES and name in vars(self):
            raise ConfigError(
                f"{name} cannot be replaced, because it is used inside {INNER_STAGES[name]}; replace that instead"
            )
        if not hasattr(self, name) and name not in (*STAGES, *RESULTS):
            for stage in get_close_matches(name, STAGES, n=1, cutoff=_SIMILARITY):
                raise ConfigError(f"{name} is not a stage; did you mean {stage}?")
        value = without_hooks(value)  # those of this system are added below
        if name in STAGES:
            _check_stage(name, value)
        if name in RESULTS and name in vars(self):
            value = ReplacedStage(value, name, vars(self)[name])
        previous = vars(self).get(name)
        if isinstance(previous, HookedStage):
            previous._hooks = {}  # the new stage can be a wrapper that calls it; hooks see the wrapper only
            value = HookedStage(value, name, self._stage_hooks)
        super().__setattr__(name, value)

    @property
    def replaced_stages(self) -> list[str]:
        """Names of the stages that were replaced, except the segmenter."""
        return [name for name in RESULTS if isinstance(without_hooks(vars(self)[name]), ReplacedStage)]

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
