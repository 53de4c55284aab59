"""Export of a network with published weights to an ONNX file of fixed input size, stored in the cache."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from v3d_torch.errors import WeightsError
from v3d_torch.io.derived_files import derive
from v3d_torch.io.paths import cache_dir
from v3d_torch.segmentation.networks import LayerGraph, one_to_one, yolo11n_seg, yolo26n_seg, yolov8n_seg
from v3d_torch.segmentation.networks.head import Segment, boxes_from_distances, cell_grid
from v3d_torch.segmentation.parts import INNER_TENSORS, OUTPUTS
from v3d_torch.segmentation.pt_weights import read_pt_weights
from v3d_torch.segmentation.weights import REGISTRY

_VERSION = 4
"""Version of the exported files, part of their name: increase it when the export changes, so that files of earlier
versions in the cache are not used."""

_OPSET = 17
"""ONNX operator set of the exported files."""

_BUILDERS: dict[str, Callable[[], LayerGraph]] = {
    "yolov8n-seg": yolov8n_seg,
    "yolo11n-seg": yolo11n_seg,
    "yolo26n-seg": yolo26n_seg,
}


def exported_path(model: str, weights: Path, height: int, width: int) -> Path:
    """Path of the ONNX file for images of one size; the file is written on first use, or if damaged.

    Args:
        model: Name of the model, a key of `REGISTRY`.
        weights: Published ``.pt`` file of the model.
        height: Rows of the network input, a multiple of 32.
        width: Columns of the network input, a multiple of 32.

    Returns:
        A file in the cache with the inputs and outputs described at `export`.

    Raises:
        WeightsError: If the weights are not those of the model.
        OutputError: If the cache is not writable.
    """
    sha256 = REGISTRY[model].sha256
    target = cache_dir() / "networks" / f"{model}-{sha256[:12]}-{height}x{width}-v{_VERSION}.onnx"

    def write(draft: Path) -> None:
        with _default_float32():
            export(build(model, read_pt_weights(weights, sha256)), height, width, draft)

    derive([target], write)
    return target


@contextmanager
def _default_float32() -> Iterator[None]:
    """Set the default dtype of torch, which parameters and constants of an exported network have."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def build(model: str, tensors: dict[str, Tensor]) -> LayerGraph:
    """Build a network with given weights, in evaluation mode.

    Args:
        model: Name of the model, a key of `REGISTRY`.
        tensors: Parameters and buffers by name, see `read_pt_weights`; tensors used only in training are ignored.

    Raises:
        WeightsError: If a tensor is missing or has another shape.
    """
    network = _BUILDERS[model]()
    if REGISTRY[model].one_to_one:
        tensors = one_to_one(tensors)
    try:
        network.load_state_dict({name: tensors[name] for name in network.state_dict()})
    except (KeyError, RuntimeError) as error:
        raise WeightsError(f"{model}: the tensors in the weights do not match this network ({error})") from error
    return network.eval()


class _Exported(nn.Module):
    """A network that also returns the tensors named in `INNER_TENSORS`."""

    def __init__(self, network: LayerGraph) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        head = cast("Segment", self.network.model[-1])
        pyramid = self.network.pyramid(image)
        distances, scores, coefficients = head.distances(pyramid), head.scores(pyramid), head.coefficients(pyramid)
        boxes = boxes_from_distances(distances, *cell_grid([level.shape[2:] for level in pyramid]))
        predictions = torch.cat([boxes, scores, coefficients], dim=1)
        return predictions, head.proto(pyramid), *pyramid, scores, distances, coefficients


def export(network: LayerGraph, height: int, width: int, path: Path) -> None:
    """Write a network as an ONNX file.

    The input ``images`` has the shape (1, 3, H, W); the outputs ``output0`` (predictions) and ``output1`` (prototypes)
    are those of `LayerGraph`. Inside the file, the tensors at which `split` cuts it have the names `INNER_TENSORS`.

    Args:
        network: Network in evaluation mode.
        height: Rows of the input, a multiple of 32.
        width: Columns of the input, a multiple of 32.
        path: File to write.
    """
    import onnx  # a slow import, needed only for files that are not in the cache

    with warnings.catch_warnings(), torch.inference_mode():
        # Ignore the deprecation warning of this exporter: its successor needs an additional package.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            _Exported(network).eval(),
            (torch.zeros(1, 3, height, width),),
            path,
            input_names=["images"],
            output_names=[*OUTPUTS, *INNER_TENSORS],
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(path)
    del model.graph.output[len(OUTPUTS) :]  # the inner tensors keep their names
    onnx.save(model, path)
