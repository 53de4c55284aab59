"""Networks on onnxruntime: a whole network, or its parts, of which each image runs only those that it needs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import WeightsError
from v3d_torch.segmentation.coco import COCO_NAMES
from v3d_torch.segmentation.letterbox import CELL
from v3d_torch.segmentation.networks.head import STRIDES, boxes_from_distances, cell_grid
from v3d_torch.segmentation.networks.prototypes import PROTOTYPES
from v3d_torch.segmentation.onnx_runtime import import_onnxruntime
from v3d_torch.segmentation.parts import LEVELS, PartPaths

if TYPE_CHECKING:
    import onnxruntime

_BOX = 4
"""Number of rows of the raw predictions for the box; class scores and mask coefficients follow."""

_MARGIN = 2
"""Cells around a cell that its box and mask coefficients depend on: one for each of two 3x3 convolutions."""

_Array = NDArray[np.float32]


class NetworkOutput(Protocol):
    """Output of a network for one image, computed on demand."""

    @property
    def scores(self) -> Tensor:
        """Scores of C classes in all cells, float32, shape :math:`(C, N)`."""

    def detections(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes and mask coefficients of some cells.

        Args:
            cells: Indices of n cells, int64, shape :math:`(n,)`.

        Returns:
            Centre x, centre y, width and height of the boxes in canvas pixels, float32, shape :math:`(4, n)`, and
            coefficients of P prototypes, float32, shape :math:`(P, n)`.
        """

    def prototypes(self, rows: slice, columns: slice) -> Tensor:
        """Section of the mask prototypes, float32, shape :math:`(P, h, w)`; each cell covers 4 x 4 canvas pixels."""


class WholeOutput:
    """Output of a whole network for one image.

    Args:
        predictions: Raw predictions, float32, shape :math:`(4 + C + P, N)`: centre x, centre y, width and height of the
            box in canvas pixels, scores of C classes, coefficients of P prototypes.
        prototypes: Mask prototypes, float32, shape :math:`(P, H, W)`.
    """

    def __init__(self, predictions: Tensor, prototypes: Tensor) -> None:
        self._boxes, self.scores, self._coefficients = predictions.tensor_split(
            (_BOX, len(predictions) - len(prototypes))
        )
        self._prototypes = prototypes

    def detections(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes and mask coefficients of some cells, see `NetworkOutput`."""
        return self._boxes[:, cells], self._coefficients[:, cells]

    def prototypes(self, rows: slice, columns: slice) -> Tensor:
        """Section of the mask prototypes, see `NetworkOutput`."""
        return self._prototypes[:, rows, columns]


class WholeNetwork:
    """Network in one file.

    Args:
        path: ONNX file with a raw segmentation head.
        threads: Number of threads.

    Attributes:
        height: Rows of the input.
        width: Columns of the input.

    Raises:
        WeightsError: If the file is missing, damaged or of another kind of network.
    """

    def __init__(self, path: Path, threads: int) -> None:
        self.path = path
        self._session = open_session(path, threads)
        self.height, self.width = _check_layout(self._session, path)
        self._input = self._session.get_inputs()[0].name

    def __call__(self, canvas: Tensor) -> WholeOutput:
        """Run the network on a canvas, float32, shape :math:`(1, 3, height, width)`."""
        predictions, prototypes = _run(self._session, {self._input: canvas.numpy()}, self.path)
        return WholeOutput(torch.from_numpy(predictions)[0], torch.from_numpy(prototypes)[0])


class SplitNetwork:
    """Network in parts.

    Args:
        paths: Files of the parts.
        threads: Number of threads.

    Attributes:
        height: Rows of the input.
        width: Columns of the input.

    Raises:
        WeightsError: If a file is damaged.
    """

    def __init__(self, paths: PartPaths, threads: int) -> None:
        self.paths = paths
        self.parts = [open_session(path, threads) for path in paths]
        image = self.parts[0].get_inputs()[0]
        self.height, self.width = image.shape[2:]
        self._input = image.name
        self.centres, self.strides = cell_grid([(self.height // side, self.width // side) for side in STRIDES])
        self.prototype_levels = [LEVELS.index(level.name) for level in self.parts[2].get_inputs()]

    def __call__(self, canvas: Tensor) -> SplitOutput:
        """Run the part that computes scores, on a canvas, float32, shape :math:`(1, 3, height, width)`."""
        *pyramid, scores = _run(self.parts[0], {self._input: canvas.numpy()}, self.paths.scores)
        return SplitOutput(self, pyramid, torch.from_numpy(scores)[0])


class SplitOutput:
    """Output of a network in parts for one image; the head runs on sections of the feature maps.

    Args:
        network: Network.
        pyramid: Feature maps at strides 8, 16 and 32, shapes :math:`(1, C_i, H/s, W/s)`.
        scores: Scores of C classes in all cells, float32, shape :math:`(C, N)`.
    """

    def __init__(self, network: SplitNetwork, pyramid: list[_Array], scores: Tensor) -> None:
        self._network = network
        self._pyramid = pyramid
        self.scores = scores

    def detections(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes and mask coefficients of some cells, see `NetworkOutput`."""
        if len(cells) == 0:
            return self.scores.new_zeros(_BOX, 0), self.scores.new_zeros(PROTOTYPES, 0)
        sections, indices = {}, cells.numpy()
        positions = np.empty_like(indices)  # of the cells among those of all sections
        first_cell = first_position = 0
        for name, level in zip(LEVELS, self._pyramid, strict=True):
            height, width = level.shape[2:]
            members = (first_cell <= indices) & (indices < first_cell + height * width)
            v, u = np.divmod(indices[members] - first_cell, width)
            # A level without cells gets a section of one cell, because the part needs an input for every level.
            rows, columns = (_section(x, size) if len(x) else slice(0, 1) for x, size in ((v, height), (u, width)))
            sections[name] = np.ascontiguousarray(level[:, :, rows, columns])
            section_width = columns.stop - columns.start
            positions[members] = first_position + (v - rows.start) * section_width + u - columns.start
            first_cell += height * width
            first_position += (rows.stop - rows.start) * section_width
        distances, coefficients = _run(self._network.parts[1], sections, self._network.paths.detections)
        return (
            boxes_from_distances(
                torch.from_numpy(distances[:, :, positions]),
                self._network.centres[:, cells],
                self._network.strides[cells],
            )[0],
            torch.from_numpy(coefficients[0, :, positions].T),
        )

    def prototypes(self, rows: slice, columns: slice) -> Tensor:
        """Section of the mask prototypes, see `NetworkOutput`."""
        levels = self._network.prototype_levels
        if len(levels) > 1:
            inputs, top, left = {LEVELS[level]: self._pyramid[level] for level in levels}, 0, 0
        else:
            # A prototype depends on a 3x3 neighbourhood, which depends on 3x3 cells of twice the size.
            height, width = self._pyramid[0].shape[2:]
            top, left = (max((side.start - 1) // 2 - 1, 0) for side in (rows, columns))
            bottom, right = (min(side.stop // 2 + 2, size) for side, size in ((rows, height), (columns, width)))
            inputs = {LEVELS[0]: np.ascontiguousarray(self._pyramid[0][:, :, top:bottom, left:right])}
        (prototypes,) = _run(self._network.parts[2], inputs, self._network.paths.prototypes)
        rows, columns = (
            slice(side.start - 2 * first, side.stop - 2 * first) for side, first in ((rows, top), (columns, left))
        )
        return torch.from_numpy(prototypes)[0, :, rows, columns]


def _section(cells: NDArray[np.int64], size: int) -> slice:
    """Rows or columns of a feature map on which the results in some cells depend."""
    return slice(max(int(cells.min()) - _MARGIN, 0), min(int(cells.max()) + _MARGIN + 1, size))


def _run(session: onnxruntime.InferenceSession, inputs: dict[str, _Array], path: Path) -> list[_Array]:
    """Run a network; raises WeightsError if onnxruntime fails, or an output contains NaN or infinity."""
    try:
        outputs: list[Any] = session.run(None, inputs)
    except Exception as error:  # the exceptions of onnxruntime have no common base class
        raise WeightsError(f"{path}: onnxruntime cannot run this network; export it again") from error
    if not all(np.isfinite(output).all() for output in outputs):
        raise WeightsError(f"{path}: network output contains NaN or infinity; train or export it again")
    return outputs


def open_session(path: Path, threads: int) -> onnxruntime.InferenceSession:
    """Load a network into onnxruntime, deterministic and on the CPU.

    Raises:
        WeightsError: If the file is missing, or not a network that onnxruntime can load.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: no such file; check the path given with --weights")
    ort = import_onnxruntime()
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    # An arena would keep memory for all sizes of the sections of feature maps, which differ from image to image.
    options.enable_cpu_mem_arena = False
    # Spinning threads would slow down torch, which computes between two calls.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # only fatal errors: others are raised
    try:
        return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the exceptions of onnxruntime have no common base class
        raise WeightsError(
            f"{path}: is not a network that onnxruntime can load; delete the file or export it again"
        ) from error


def _check_layout(session: onnxruntime.InferenceSession, path: Path) -> tuple[int, int]:
    """Height and width of the network input; raises WeightsError unless the network has a raw segmentation head."""
    inputs = [(node.type, node.shape) for node in session.get_inputs()]
    outputs = [(node.type, node.shape) for node in session.get_outputs()]
    match inputs:
        case [("tensor(float)", [1, 3, int(height), int(width)])] if height % STRIDES[-1] == width % STRIDES[-1] == 0:
            cells = sum(height * width // stride**2 for stride in STRIDES)
            raw_head = [[1, 4 + len(COCO_NAMES) + PROTOTYPES, cells], [1, PROTOTYPES, height // CELL, width // CELL]]
            if outputs == [("tensor(float)", shape) for shape in raw_head]:
                return height, width
    raise WeightsError(
        f"{path}: is not a raw segmentation head with one float input (1, 3, H, W), H and W fixed multiples of 32, and"
        f" outputs (1, 116, N) and (1, 32, H/4, W/4): it maps {inputs} to {outputs};"
        " export it with a fixed size and without NMS"
    )
