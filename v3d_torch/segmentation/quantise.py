"""Static 8-bit quantisation of a network's convolutions (Jacob et al., CVPR 2018).

Integer convolutions are faster on processors with 8-bit vector instructions. The range of every activation is
calibrated on rendered frames of the demo: nothing has to be downloaded, and every machine uses the same frames.
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
from v3d_torch.io.derived_files import derive
from v3d_torch.segmentation.letterbox import letterbox
from v3d_torch.segmentation.onnx_runtime import import_onnxruntime

if TYPE_CHECKING:
    import onnx

_VERSION = 3
"""Version of the quantised files, part of their name: increase it when the quantisation changes, so that files of
earlier versions in the cache are not used."""

_CALIBRATION_INTERVAL = 15
"""Interval between calibration frames, in frames of the demo: they show people in full and cut off by the image border,
on dark and on bright backgrounds."""

_FIRST_FLOAT_CONVOLUTIONS = 5
"""Number of convolutions at the input that stay in floating point: their errors propagate through all later layers, and
without them people are missed."""

_ORT_DOMAIN = "com.microsoft"
"""Domain of operators that are specific to onnxruntime."""


def has_int8_instructions() -> bool:
    """Check whether the processor has 8-bit vector instructions; older x86 processors overflow in 16-bit sums."""
    return platform.machine() not in ("x86_64", "AMD64") or torch.cpu._is_vnni_supported()


def quantised_path(path: Path) -> Path:
    """Path of the 8-bit version of a network, beside the original; the file is written on first use, or if damaged.

    Args:
        path: ONNX file with one input of shape (1, 3, H, W), RGB in [0, 1].

    Returns:
        An ONNX file with the same inputs and outputs.

    Raises:
        OutputError: If the folder is not writable.
    """
    target = path.with_name(f"{path.stem}-int8-v{_VERSION}.onnx")
    derive([target], lambda draft: quantise(path, _calibration_images(), draft))
    return target


def _calibration_images() -> list[Tensor]:
    """Rendered colour images of the demo, each uint8, shape (3, H, W)."""
    # A slow import, needed only when a network is quantised.
    from v3d_torch.datasets.demo.sequence import FRAME_COUNT, write_sequence

    with tempfile.TemporaryDirectory() as folder:
        write_sequence(Path(folder), range(0, FRAME_COUNT, _CALIBRATION_INTERVAL))
        return [read_colour(image) for image in sorted((Path(folder) / "rgb").iterdir())]


def quantise(path: Path, images: Iterable[Tensor], target: Path) -> None:
    """Write a version of a network with 8-bit convolutions, for onnxruntime.

    Args:
        path: ONNX file with one input of shape (1, 3, H, W), RGB in [0, 1].
        images: Calibration images, uint8 RGB, each of shape :math:`(3, H, W)`.
        target: ONNX file to write.
    """
    import_onnxruntime()
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    model = onnx.load(path)
    image_input = model.graph.input[0]
    _, _, height, width = (size.dim_value for size in image_input.type.tensor_type.shape.dim)
    canvases = ({image_input.name: letterbox(image, height, width)[0].numpy()} for image in images)

    class CalibrationCanvases(CalibrationDataReader):  # type: ignore[misc]
        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            return next(canvases, None)

    disabled = logging.root.manager.disable
    # onnxruntime recommends a fusion that the exporter has already done.
    logging.disable(max(disabled, logging.WARNING))
    try:
        quantize_static(
            str(path),
            str(target),
            CalibrationCanvases(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=_float_convolutions(model.graph),
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    finally:
        logging.disable(disabled)
    quantised = onnx.load(target)
    _fuse_activations(quantised)
    onnx.save(quantised, target)


def _fuse_activations(model: onnx.ModelProto) -> None:
    """Replace each x * sigmoid(x) by one operator, in place.

    onnxruntime does not do so after an integer convolution: it dequantises x once for the product and once for the
    sigmoid, and then does not recognise them as the same tensor.
    """
    import onnx

    graph = model.graph
    sigmoids = {node.output[0]: node for node in graph.node if node.op_type == "Sigmoid"}
    for product in [node for node in graph.node if node.op_type == "Mul"]:
        for gate in sigmoids.keys() & set(product.input):
            x = sigmoids[gate].input[0]
            if x in product.input:
                # With alpha = 1, QuickGelu is x * sigmoid(x).
                fused = onnx.helper.make_node("QuickGelu", [x], list(product.output), domain=_ORT_DOMAIN, alpha=1.0)
                product.CopyFrom(fused)
                graph.node.remove(sigmoids[gate])
    if all(opset.domain != _ORT_DOMAIN for opset in model.opset_import):
        model.opset_import.append(onnx.helper.make_opsetid(_ORT_DOMAIN, 1))


def _float_convolutions(graph: onnx.GraphProto) -> list[str]:
    """Names of the convolutions that stay in floating point: the first ones, and the output layers.

    Output layers are the convolutions without an activation. Boxes range over hundreds of pixels and scores differ by
    hundredths; 8 bits cannot represent both.
    """
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    activated = {name for node in graph.node if node.op_type == "Sigmoid" for name in node.input}
    output_layers = [node for node in convolutions if node.output[0] not in activated]
    return [node.name for node in [*convolutions[:_FIRST_FLOAT_CONVOLUTIONS], *output_layers]]
