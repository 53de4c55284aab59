"""Safe reading of published ``.pt`` weights: no code from the file is executed.

Such a file is a pickle of a tree of module objects of another library, and a pickle can call any function by name.
Therefore the checksum is verified first. Then torch's restricted unpickler reads the file and rejects every name that
is not allowed. The allowed module classes are replaced by `_InertModule`, which only stores attributes.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from v3d_torch.errors import WeightsError
from v3d_torch.io.text import first_line
from v3d_torch.segmentation.weights import sha256_of

_MODULE_CLASSES = {
    "torch.nn.modules": (
        "activation.SiLU", "batchnorm.BatchNorm2d", "container.ModuleList", "container.Sequential", "conv.Conv2d",
        "conv.ConvTranspose2d", "linear.Identity", "pooling.MaxPool2d", "upsampling.Upsample",
    ),
    "ultralytics.nn": (
        "tasks.SegmentationModel",
        "modules.Bottleneck", "modules.C2f", "modules.Concat", "modules.Conv", "modules.DFL", "modules.Detect",
        "modules.Proto", "modules.SPPF", "modules.Segment",
        "modules.block.Attention", "modules.block.Bottleneck", "modules.block.C2PSA", "modules.block.C3k",
        "modules.block.C3k2", "modules.block.DFL", "modules.block.PSABlock", "modules.block.Proto",
        "modules.block.Proto26", "modules.block.SPPF", "modules.conv.Concat", "modules.conv.Conv",
        "modules.conv.DWConv", "modules.head.Detect", "modules.head.Segment", "modules.head.Segment26",
    ),
}  # fmt: skip


class _InertModule:
    """Replacement for every module class in a file: stores the attributes and has no behaviour."""


def _inert_getattr(*_: Any) -> None:
    """Replacement for ``getattr``, with which some files refer to a method: returns None."""


_ALLOWED: list[Callable[..., Any] | tuple[Callable[..., Any], str]] = [
    *((_InertModule, f"{package}.{name}") for package, names in _MODULE_CLASSES.items() for name in names),
    (_inert_getattr, "builtins.getattr"),
]


def read_pt_weights(path: Path, sha256: str) -> dict[str, Tensor]:
    """Read the parameters and buffers of a network from a published ``.pt`` file.

    Args:
        path: Published ``.pt`` file.
        sha256: Expected checksum of the file, hexadecimal; verified before the file is unpickled.

    Returns:
        Parameters and buffers by name, with the names of ``state_dict``.

    Raises:
        WeightsError: If the checksum differs, or the file refers to a name that is not allowed.
    """
    if sha256_of(path) != sha256:
        raise WeightsError(f"{path}: the checksum is not {sha256}; delete the file, it is then downloaded again")
    try:
        with torch.serialization.safe_globals(_ALLOWED):
            content = torch.load(path, map_location="cpu", weights_only=True)
        return dict(_named_tensors(content["model"]))
    except (pickle.UnpicklingError, RuntimeError, EOFError, AttributeError, KeyError, TypeError) as error:
        raise WeightsError(
            f"{path}: cannot be read safely as network weights ({first_line(error)}); use the published file"
        ) from error


def _named_tensors(module: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """Parameters and buffers of a module and its children, with their full names."""
    for name, tensor in (module._parameters | module._buffers).items():
        if tensor is not None:
            yield prefix + name, tensor
    for name, child in module._modules.items():
        if child is not None:
            yield from _named_tensors(child, f"{prefix}{name}.")
