"""Components with state that changes from frame to frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable


@runtime_checkable
class Stateful(Protocol):
    """A component with state that changes from frame to frame, saved and restored as in `torch.nn.Module`."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state: tensors, numbers and data classes of the package."""

    def load_state_dict(self, state: Mapping[str, Any]) -> Any:
        """Restore a state that `state_dict` of a component with the same configuration returned."""


class StatefulComponent:
    """Base class of components whose state is that of some of their attributes.

    The keys of a state are the names of the attributes without a leading underscore. An attribute that is a component
    with state saves and restores its own.
    """

    _STATE: ClassVar[tuple[str, ...]]
    """Names of the attributes."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state, which shares its objects with the component."""
        attributes = {name.removeprefix("_"): getattr(self, name) for name in self._STATE}
        return {key: value.state_dict() if is_stateful(value) else value for key, value in attributes.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`; its objects are shared, not copied."""
        for name in self._STATE:
            own, stored = getattr(self, name), state[name.removeprefix("_")]
            if is_stateful(own):
                own.load_state_dict(stored)
            else:
                setattr(self, name, stored)


def is_stateful(component: object) -> bool:
    """Check whether a component has ``state_dict`` and ``load_state_dict``."""
    return has_methods(component, "state_dict", "load_state_dict")


def has_methods(value: object, *methods: str) -> bool:
    """Check for methods by name: since Python 3.12, isinstance does not find the methods that a proxy forwards."""
    return all(callable(getattr(value, method, None)) for method in methods)
