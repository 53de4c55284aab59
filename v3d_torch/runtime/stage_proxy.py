"""Proxy of a stage: base class of wrappers that check the results of the stage."""

from __future__ import annotations

from typing import Any

STATE_METHODS = frozenset({"state_dict", "load_state_dict"})
"""Methods of stages with state, see `v3d_torch.runtime.stateful.Stateful`."""


class StageProxy:
    """Proxy that checks the results of a stage; attributes are read from and written to the stage itself.

    Args:
        stage: Stage.
        name: Name of the stage in messages.
    """

    _OWN = frozenset({"_stage", "_name"})
    """Attributes of the proxy itself."""

    def __init__(self, stage: Any, name: str) -> None:
        self._stage = stage
        self._name = name

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the stage and check its result."""
        result = self._stage(*args, **kwargs)
        self._check(result, *args)
        return result

    def _check(self, result: Any, *args: Any) -> None:
        """Check the result of a call; the positional arguments of the call are passed on."""
        raise NotImplementedError

    def __getattr__(self, name: str) -> Any:
        if name in self._OWN:  # read before it is set, for example by copy
            raise AttributeError(name)
        return getattr(self._stage, name)

    def __setattr__(self, name: str, value: object) -> None:
        if name in self._OWN:
            super().__setattr__(name, value)
        else:
            setattr(self._stage, name, value)
