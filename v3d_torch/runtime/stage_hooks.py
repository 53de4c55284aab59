"""Hooks that see the arguments and the result of every call of a stage."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import Any

from v3d_torch.runtime.stage_proxy import StageProxy

StageHook = Callable[[str, tuple[Any, ...], Any], object]
"""Function of the name of a stage, the arguments of a call in their order, and the result; returns are ignored."""

StageHooks = MutableMapping[int, tuple[str | None, StageHook]]
"""Hooks by the id of their handle, in the order of registration, each with the name of its stage; None for all."""


class HookedStage(StageProxy):
    """Proxy of a stage that calls hooks after each call of the stage.

    Args:
        stage: Stage.
        name: Name of the stage.
        hooks: Hooks of all stages; later changes take effect.
    """

    _OWN = StageProxy._OWN | {"_hooks"}

    def __init__(self, stage: Any, name: str, hooks: StageHooks) -> None:
        super().__init__(stage, name)
        self._hooks = hooks

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the stage, then its hooks."""
        result = self._stage(*args, **kwargs)
        for stage, hook in tuple(self._hooks.values()):  # a hook can remove itself
            if stage in (None, self._name):
                hook(self._name, (*args, *kwargs.values()), result)
        return result

    def __getattr__(self, name: str) -> Any:
        value = super().__getattr__(name)
        # Segmenters that use the pose are called by this method.
        return HookedStage(value, self._name, self._hooks) if name == "segment_with_pose" else value


def without_hooks(stage: Any) -> Any:
    """Return a stage without the hooks of the system from which it was read."""
    return stage._stage if type(stage) is HookedStage else stage
