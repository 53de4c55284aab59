"""From a checkpoint to an ONNX file for one input size, kept in the cache."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from v3d_torch.errors import WeightsError
from v3d_torch.io.download import cache_dir
from v3d_torch.io.files import atomic_write, file_lock
from v3d_torch.segmentation.networks import one_to_one, yolo11n_seg, yolo26n_seg, yolov8n_seg
from v3d_torch.segmentation.pt_file import read_checkpoint
from v3d_torch.segmentation.weights import REGISTRY

_VERSION = 3
"""Of what this file makes of a checkpoint: raised with every change, so that older files in the cache are not used."""

_OPSET = 17

_BUILDERS: dict[str, Callable[[], nn.Module]] = {
    "yolov8n-seg": yolov8n_seg,
    "yolo11n-seg": yolo11n_seg,
    "yolo26n-seg": yolo26n_seg,
}


def exported_path(model: str, checkpoint: Path, height: int, width: int) -> Path:
    """The ONNX file of a checkpoint for images of one size, made on first use.

    Args:
        model: a key of the registry of weights.
        checkpoint: its ``.pt`` file.
        height: rows of the input, a multiple of 32.
        width: columns of the input, a multiple of 32.

    Returns:
        A file in the cache with the layout that `export` describes.

    Raises:
        WeightsError: if the checkpoint is not the model's.
        OutputError: if the cache cannot be written.
    """
    sha256 = REGISTRY[model].sha256
    target = cache_dir() / "networks" / f"{model}-{sha256[:12]}-{height}x{width}-v{_VERSION}.onnx"
    if target.is_file():
        return target
    with file_lock(target):
        if not target.is_file():
            network = build(model, read_checkpoint(checkpoint, sha256))
            with atomic_write(target) as draft:
                export(network, height, width, draft)
    return target


def build(model: str, tensors: dict[str, Tensor]) -> nn.Module:
    """The network with a checkpoint's tensors, ready for inference.

    Args:
        model: a key of the registry of weights.
        tensors: by name, as `read_checkpoint` gives them; what serves only training may be among them.

    Raises:
        WeightsError: if a tensor is missing or has another shape.
    """
    network = _BUILDERS[model]()
    if REGISTRY[model].one_to_one:
        tensors = one_to_one(tensors)
    try:
        network.load_state_dict({name: tensors[name] for name in network.state_dict()})
    except (KeyError, RuntimeError) as error:
        raise WeightsError(f"{model}: the checkpoint's tensors are not this network's ({error})") from error
    return network.eval()


def export(network: nn.Module, height: int, width: int, path: Path) -> None:
    """Write a network as ONNX: ``images`` (1, 3, H, W) in, ``output0`` and ``output1`` out as `LayerGraph` has them."""
    with warnings.catch_warnings(), torch.inference_mode():
        # The exporter announces its successor, which needs a package more; what it writes is checked by the tests.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            (torch.zeros(1, 3, height, width),),
            path,
            input_names=["images"],
            output_names=["output0", "output1"],
            opset_version=_OPSET,
            dynamo=False,
        )
