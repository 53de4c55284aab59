"""Instance segmentation with a YOLO network on onnxruntime (paper, Sec. III-A)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from v3d_torch.config import SegmentationConfig
from v3d_torch.errors import WeightsError
from v3d_torch.segmentation.coco import COCO_NAMES
from v3d_torch.segmentation.decode import decode
from v3d_torch.segmentation.export import exported_path
from v3d_torch.segmentation.letterbox import CELL, letterbox
from v3d_torch.segmentation.networks.head import STRIDES
from v3d_torch.segmentation.networks.prototypes import PROTOTYPES
from v3d_torch.segmentation.quantise import has_int8_instructions, quantised_path
from v3d_torch.segmentation.suppression import suppress_duplicates
from v3d_torch.segmentation.weights import REGISTRY, find_weights
from v3d_torch.types import Instances, RGBDFrame


class YOLOSegmenter:
    """YOLO network that segments instances of the 80 COCO classes.

    Args:
        config: Configuration of the segmentation: model, input size, thresholds, threads.
        weights: Published ``.pt`` file of the model, or an ``.onnx`` file with a raw segmentation head, the input size
            of which replaces the configured one; None searches the cache and downloads the published file.

    Attributes:
        height: Rows of the network input.
        width: Columns of the network input.

    Raises:
        WeightsError: If the weights are missing, damaged or of another network.
    """

    def __init__(self, config: SegmentationConfig, weights: Path | None = None) -> None:
        if weights is not None and weights.suffix == ".onnx":
            path = weights
        else:
            path = exported_path(config.model, find_weights(config.model, weights), config.height, config.width)
            if config.precision == "int8" and has_int8_instructions():
                path = quantised_path(path)
        self.config = config
        self._path = path
        self._session = _open_session(path, config.threads)
        self._input = self._session.get_inputs()[0].name
        self.height, self.width = _check_layout(self._session, path)
        self._iou_threshold = None if REGISTRY[config.model].one_to_one else config.iou_threshold

    def __reduce__(self) -> tuple[type[YOLOSegmenter], tuple[SegmentationConfig, Path]]:
        """Pickle by configuration and path: sessions cannot be pickled, the other process opens the file again."""
        return YOLOSegmenter, (self.config, self._path)

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Segment the colour image of a frame."""
        return self.segment(frame.image)

    def segment(self, image: Tensor) -> Instances:
        """Segment an image of any size.

        Args:
            image: Colour image, uint8 RGB, shape :math:`(3, H, W)`.

        Returns:
            Instances in the image, best score first. Boxes are pixel edges: pixel u is inside a box if
            left <= u < right.

        Raises:
            WeightsError: If onnxruntime fails to run the network, or its output contains NaN or infinity.
        """
        canvas, window = letterbox(image, self.height, self.width)
        try:
            predictions, prototypes = self._session.run(None, {self._input: canvas.numpy()})
        except Exception as error:  # the exceptions of onnxruntime have no common base class
            raise WeightsError(f"{self._path}: onnxruntime cannot run this network; export it again") from error
        if not (np.isfinite(predictions).all() and np.isfinite(prototypes).all()):
            raise WeightsError(f"{self._path}: network output contains NaN or infinity; train or export it again")
        instances = decode(
            torch.from_numpy(predictions)[0],
            torch.from_numpy(prototypes)[0],
            window,
            score_threshold=self.config.score_threshold,
            iou_threshold=self._iou_threshold,
            max_instances=self.config.max_instances,
        )
        return suppress_duplicates(instances, self.config.duplicate_overlap)


def _open_session(path: Path, threads: int) -> onnxruntime.InferenceSession:
    """Load a network into onnxruntime, deterministic and on the CPU."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such file; check the path given with --weights")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    # Waiting threads that spin would slow down torch, which computes between two calls.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
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
