"""Base class of modules that keep the settings of a function."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor


class SettingsModule(torch.nn.Module):
    """Module with a setting for each parameter of its constructor, in an attribute of the same name.

    If the first value of a setting is a tensor, but no `torch.nn.Parameter`, the setting is a buffer: ``to()`` moves
    it, ``state_dict()`` contains it, and later values must be tensors, too.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute, or register a buffer if the value is a tensor and the attribute is new."""
        if isinstance(value, Tensor) and not isinstance(value, torch.nn.Parameter) and not hasattr(self, name):
            self.register_buffer(name, value)
        else:
            super().__setattr__(name, value)

    def extra_repr(self) -> str:
        """Return the settings, for ``repr()``."""
        settings = {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}
        shown = {name: each.detach() if isinstance(each, Tensor) else each for name, each in settings.items()}
        return ", ".join(f"{name}={each}" for name, each in shown.items())
