"""Proxies of stages: base classes of wrappers that show or check the results of a stage."""

from __future__ import annotations

from typing import Any

STATE_METHODS = frozenset({"state_dict", "load_state_dict"})
"""Methods of stages with state, see `v3d_torch.runtime.stateful.Stateful`."""


class StageProxy:
    """Proxy of a stage: attributes are read from and written to the stage itself.

    `isinstance` sees the class of the stage. So a segmenter that is a torch module counts as stateless behind a proxy,
    too, see `segmenter_state_of`.

    Args:
        stage: Stage.
        name: Name of the stage in messages.
    """

    _OWN = frozenset({"_stage", "_name"})
    """Attributes of the proxy itself."""

    def __init__(self, stage: Any, name: str) -> None:
        self._stage = stage
        self._name = name

    @property  # type: ignore[misc]  # object declares a plain attribute
    def __class__(self) -> type:
        return self._stage.__class__

    def __getattr__(self, name: str) -> Any:
        if name in self._OWN:  # read before it is set, for example by copy
            raise AttributeError(name)
        return getattr(self._stage, name)

    def __setattr__(self, name: str, value: object) -> None:
        if name in self._OWN:
            super().__setattr__(name, value)
        else:
            setattr(self._stage, name, value)


class CheckingProxy(StageProxy):
    """Proxy that checks the results of a stage."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the stage and check its result."""
        result = self._stage(*args, **kwargs)
        self._check(result, *args)
        return result

    def _check(self, result: Any, *args: Any) -> None:
        """Check the result of a call; the positional arguments of the call are passed on."""
        raise NotImplementedError
