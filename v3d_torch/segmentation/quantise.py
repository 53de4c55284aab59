"""The network in 8-bit integers: half the time on processors that multiply these in vectors.

Static quantisation of the convolutions (Jacob et al., CVPR 2018): the range of every activation is taken from frames
that the network is shown once. They are rendered here, so that nothing has to be downloaded and every machine takes the
same.
"""

from __future__ import annotations

import logging
import platform
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.images import read_colour
from v3d_torch.io.files import atomic_write, file_lock
from v3d_torch.segmentation.letterbox import letterbox

if TYPE_CHECKING:
    import onnx

_VERSION = 3
"""Of what this file makes of a network: raised with every change, so that older files in the cache are not used."""

_EVERY = 15
"""Every n-th frame of the demo calibrates: people from head to toe and cut, a dark and a bright background."""

_FIRST = 5
"""Convolutions at the input that stay in floating point: their errors grow through all others. They take a tenth of the
time, and without them two people in a hundred are missed."""

_OWN = "com.microsoft"
"""Operations of onnxruntime's own."""


def has_int8_instructions() -> bool:
    """Whether this processor multiplies 8-bit integers in vectors; older ones overflow in 16 bits on the way."""
    return platform.machine() not in ("x86_64", "AMD64") or torch.cpu._is_vnni_supported()


def quantised_path(path: Path) -> Path:
    """The 8-bit sibling of a network, made on first use.

    Args:
        path: ONNX file with one input (1, 3, H, W) of RGB in [0, 1].

    Returns:
        A file beside it with the same inputs and outputs.

    Raises:
        OutputError: if the folder cannot be written.
    """
    target = path.with_name(f"{path.stem}-int8-v{_VERSION}.onnx")
    if target.is_file():
        return target
    with file_lock(target):
        if not target.is_file():
            images = _calibration_images()
            with atomic_write(target) as draft:
                quantise(path, images, draft)
    return target


def _calibration_images() -> list[Tensor]:
    # Imported where it is needed, once on a machine: half a second of every start else.
    from v3d_torch.datasets.demo.sequence import FRAMES, write_sequence

    with tempfile.TemporaryDirectory() as folder:
        write_sequence(Path(folder), range(0, FRAMES, _EVERY))
        return [read_colour(image) for image in sorted((Path(folder) / "rgb").iterdir())]


def quantise(path: Path, images: Iterable[Tensor], target: Path) -> None:
    """Write a network with its convolutions in 8-bit integers, for onnxruntime.

    Args:
        path: ONNX file with one input (1, 3, H, W) of RGB in [0, 1].
        images: that tell the range of every activation, uint8 RGB, each of shape :math:`(3, H, W)`.
        target: to be written.
    """
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    model = onnx.load(path)
    given = model.graph.input[0]
    _, _, height, width = (size.dim_value for size in given.type.tensor_type.shape.dim)
    canvases = ({given.name: letterbox(image, height, width)[0].numpy()} for image in images)

    class Frames(CalibrationDataReader):  # type: ignore[misc]
        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            return next(canvases, None)

    logging.disable(logging.WARNING)  # it recommends to fuse what the exporter has fused
    try:
        quantize_static(
            str(path),
            str(target),
            Frames(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=_kept_exact(model.graph),
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    finally:
        logging.disable(logging.NOTSET)
    small = onnx.load(target)
    _fuse_activations(small)
    onnx.save(small, target)


def _fuse_activations(model: onnx.ModelProto) -> None:
    """Make one operation of each x * sigmoid(x).

    onnxruntime does so itself, but not behind an integer convolution: there it turns x to floating point once for the
    product and once for the sigmoid, and no longer sees that they are the same.
    """
    import onnx

    graph = model.graph
    sigmoids = {node.output[0]: node for node in graph.node if node.op_type == "Sigmoid"}
    for product in [node for node in graph.node if node.op_type == "Mul"]:
        for gate in sigmoids.keys() & set(product.input):
            given = sigmoids[gate].input[0]
            if given in product.input:
                fused = onnx.helper.make_node("QuickGelu", [given], list(product.output), domain=_OWN, alpha=1.0)
                product.CopyFrom(fused)
                graph.node.remove(sigmoids[gate])
    if all(used.domain != _OWN for used in model.opset_import):
        model.opset_import.append(onnx.helper.make_opsetid(_OWN, 1))


def _kept_exact(graph: onnx.GraphProto) -> list[str]:
    """Convolutions that stay in floating point: the first ones, and those without activation, which give the results.

    Boxes reach over hundreds of pixels, scores over hundredths: no eight bits hold both.
    """
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    activated = {name for node in graph.node if node.op_type == "Sigmoid" for name in node.input}
    bare = [node for node in convolutions if node.output[0] not in activated]
    return [node.name for node in [*convolutions[:_FIRST], *bare]]
