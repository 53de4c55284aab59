"""Split of a network into parts, so that only the needed parts of its head are computed.

The class scores are computed for all cells. Boxes, mask coefficients and prototypes are needed only near detected
objects, so the other parts of the head run on sections of the feature maps. Convolutions are padded with zeros at the
border of a section, so a section has a margin; inside it, all results equal those of the whole network.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from v3d_torch.io.derived_files import derive

if TYPE_CHECKING:
    import onnx

OUTPUTS = ("output0", "output1")
"""Predictions and prototypes: the outputs of an exported network."""

LEVELS = ("level8", "level16", "level32")
"""Feature maps at strides 8, 16 and 32: the inputs of the head."""

INNER_TENSORS = (*LEVELS, "scores", "distances", "coefficients")
"""Names inside an exported network: feature maps, and outputs of the head's branches, see `Segment`."""

_VERSION = 1
"""Version of the parts, part of their name: increase it when the split changes, so that files of earlier versions in
the cache are not used."""


class PartPaths(NamedTuple):
    """ONNX files of the parts of a network.

    Attributes:
        scores: Maps the image to the feature maps and the class scores of all cells.
        detections: Maps feature maps to distances and mask coefficients of their cells.
        prototypes: Maps feature maps to prototypes; YOLO26 uses all three levels, the others the finest one.
    """

    scores: Path
    detections: Path
    prototypes: Path


def split_paths(path: Path) -> PartPaths:
    """Paths of the parts of a network, beside the original; the files are written on first use, or if damaged.

    Args:
        path: ONNX file written by `export` or `quantise`.

    Raises:
        OutputError: If the folder is not writable.
    """
    targets = PartPaths(*(path.with_name(f"{path.stem}-{part}-v{_VERSION}.onnx") for part in PartPaths._fields))
    derive(targets, lambda *drafts: split(path, PartPaths(*drafts)))
    return targets


def split(path: Path, targets: PartPaths) -> None:
    """Write the parts of a network.

    Args:
        path: ONNX file written by `export` or `quantise`.
        targets: Files to write.
    """
    import onnx  # a slow import, needed only for files that are not in the cache

    model = onnx.load(path)
    image = [value.name for value in model.graph.input]
    cuts = ((image, [*LEVELS, "scores"]), (LEVELS, ["distances", "coefficients"]), (LEVELS, ["output1"]))
    for (inputs, outputs), target in zip(cuts, targets, strict=True):
        onnx.save(_extract(model, inputs, outputs), target)


def _extract(model: onnx.ModelProto, inputs: Sequence[str], outputs: Sequence[str]) -> onnx.ModelProto:
    """Part of a network between given tensors; inputs that do not affect the outputs are left out."""
    from onnx import TensorProto, helper

    producers = {name: node for node in model.graph.node for name in node.output}
    needed, pending = set[str](), list(outputs)
    while pending:
        name = pending.pop()
        if name not in needed:
            needed.add(name)
            if name in producers and name not in inputs:
                pending.extend(producers[name].input)
    nodes = [node for node in model.graph.node if any(name in needed and name not in inputs for name in node.output)]
    known = {value.name: value for value in model.graph.input}
    graph = helper.make_graph(
        nodes,
        "part",
        [
            known.get(name) or helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, None, None, None])
            for name in inputs
            if name in needed
        ],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
        [tensor for tensor in model.graph.initializer if tensor.name in needed],
    )
    return helper.make_model(graph, opset_imports=model.opset_import, ir_version=model.ir_version)
