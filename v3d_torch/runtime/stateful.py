"""Components with state that changes from frame to frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Stateful(Protocol):
    """A component with state that changes from frame to frame, saved and restored as in `torch.nn.Module`."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state: tensors, numbers and data classes of the package."""

    def load_state_dict(self, state: Mapping[str, Any]) -> Any:
        """Restore a state that `state_dict` of a component with the same configuration returned."""


def is_stateful(component: object) -> bool:
    """Check whether a component has ``state_dict`` and ``load_state_dict``."""
    return has_methods(component, "state_dict", "load_state_dict")


def has_methods(value: object, *methods: str) -> bool:
    """Check for methods by name: since Python 3.12, isinstance does not find the methods that a proxy forwards."""
    return all(callable(getattr(value, method, None)) for method in methods)
