"""Instance segmentation with a YOLO network on onnxruntime (paper, Sec. III-A)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.config import SegmentationConfig
from v3d_torch.errors import InputError
from v3d_torch.features.brightness import brighten
from v3d_torch.io.paths import StrPath
from v3d_torch.runtime.input_checks import describe_wrong_tensor
from v3d_torch.segmentation.decode import decode
from v3d_torch.segmentation.export import exported_path
from v3d_torch.segmentation.inference import SplitNetwork, WholeNetwork
from v3d_torch.segmentation.letterbox import letterbox
from v3d_torch.segmentation.parts import split_paths
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

    def __init__(self, config: SegmentationConfig, weights: StrPath | None = None) -> None:
        weights = None if weights is None else Path(weights)
        if weights is not None and weights.suffix.lower() == ".onnx":
            self._network: WholeNetwork | SplitNetwork = WholeNetwork(weights, config.threads)
            one_to_one = False  # what the user's own network predicts is not known
        else:
            one_to_one = REGISTRY[config.model].one_to_one
            path = exported_path(config.model, find_weights(config.model, weights), config.height, config.width)
            if config.precision == "int8" and has_int8_instructions():
                path = quantised_path(path)
            self._network = SplitNetwork(split_paths(path), config.threads)
        self.config = config
        self.height, self.width = self._network.height, self._network.width
        self._weights = weights
        self._iou_threshold = None if one_to_one else config.iou_threshold

    def __reduce__(self) -> tuple[type[YOLOSegmenter], tuple[SegmentationConfig, Path | None]]:
        """Pickle by configuration and path, because sessions cannot be pickled: the other process reopens the files."""
        return YOLOSegmenter, (self.config, self._weights)

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Segment the colour image of a frame."""
        return self.segment(frame.image)

    def segment(self, image: Tensor) -> Instances:
        """Segment an image of any size. Dark images are brightened first, because the network misses people in them.

        Args:
            image: Colour image, uint8 RGB, shape :math:`(3, H, W)`.

        Returns:
            Instances in the image, best score first. Boxes are pixel edges: pixel u is inside a box if
            left <= u < right.

        Raises:
            InputError: If the image is not uint8 RGB of this shape.
            WeightsError: If onnxruntime fails to run the network, or its output contains NaN or infinity.
        """
        if (wrong := describe_wrong_tensor(image, (3, "H", "W"), torch.uint8)) is not None:
            raise InputError(f"the image to segment is {wrong}")
        canvas, window = letterbox(brighten(image), self.height, self.width)
        instances = decode(
            self._network(canvas),
            window,
            score_threshold=self.config.score_threshold,
            iou_threshold=self._iou_threshold,
            max_instances=self.config.max_instances,
        )
        return suppress_duplicates(instances, self.config.duplicate_overlap)
