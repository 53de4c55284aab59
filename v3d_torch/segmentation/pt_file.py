"""Tensors out of a published checkpoint, without running anything that is in it.

Such a file is a pickle of a whole tree of foreign module objects, and a pickle can call any function it names. So the
checksum comes first, and then torch's restricted unpickler, which refuses every name that is not on a list; the module
classes on it are read as `_Inert` objects, which hold what was stored and can do nothing.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from v3d_torch.errors import WeightsError
from v3d_torch.segmentation.weights import sha256_of

_MODULES = {
    "torch.nn.modules": (
        *("activation.SiLU", "batchnorm.BatchNorm2d", "container.ModuleList", "container.Sequential", "conv.Conv2d"),
        *("conv.ConvTranspose2d", "linear.Identity", "pooling.MaxPool2d", "upsampling.Upsample"),
    ),
    "ultralytics.nn": (
        "tasks.SegmentationModel",
        *("modules.Bottleneck", "modules.C2f", "modules.Concat", "modules.Conv", "modules.DFL", "modules.Detect"),
        *("modules.Proto", "modules.SPPF", "modules.Segment"),
        *("modules.block.Attention", "modules.block.Bottleneck", "modules.block.C2PSA", "modules.block.C3k"),
        *("modules.block.C3k2", "modules.block.DFL", "modules.block.PSABlock", "modules.block.Proto"),
        *("modules.block.Proto26", "modules.block.SPPF", "modules.conv.Concat", "modules.conv.Conv"),
        *("modules.conv.DWConv", "modules.head.Detect", "modules.head.Segment", "modules.head.Segment26"),
    ),
}


class _Inert:
    """Stands in for every module class of a checkpoint: keeps the attributes, has no behaviour."""


def _no_attribute(*_: Any) -> None:
    """Stands in for ``getattr``, with which some checkpoints name a method: nothing is looked up."""


_ALLOWED: list[Callable[..., Any] | tuple[Callable[..., Any], str]] = [
    *((_Inert, f"{package}.{name}") for package, names in _MODULES.items() for name in names),
    (_no_attribute, "builtins.getattr"),
]


def read_checkpoint(path: Path, sha256: str) -> dict[str, Tensor]:
    """Read the network's tensors by name.

    Args:
        path: a published ``.pt`` file.
        sha256: its checksum in hexadecimal digits; compared before the file is opened as a pickle.

    Returns:
        Parameters and buffers, named as ``state_dict`` would name them.

    Raises:
        WeightsError: if the checksum differs, or the file names anything that is not on the list.
    """
    if sha256_of(path) != sha256:
        raise WeightsError(f"{path}: the checksum is not {sha256}; delete the file and let it be downloaded again")
    try:
        with torch.serialization.safe_globals(_ALLOWED):
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        return dict(_tensors(checkpoint["model"]))
    except (pickle.UnpicklingError, RuntimeError, EOFError, AttributeError, KeyError, TypeError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise WeightsError(f"{path}: is not a checkpoint that can be read safely ({reason})") from error


def _tensors(module: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    for name, tensor in (module._parameters | module._buffers).items():
        if tensor is not None:
            yield prefix + name, tensor
    for name, child in module._modules.items():
        if child is not None:
            yield from _tensors(child, f"{prefix}{name}.")
