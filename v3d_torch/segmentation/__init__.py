"""Instance segmentation of colour images (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from v3d_torch.config import SegmentationConfig
from v3d_torch.errors import ConfigError
from v3d_torch.segmentation.coco import COCO_NAMES, PERSON
from v3d_torch.segmentation.none import NoSegmentation
from v3d_torch.segmentation.stored import StoredMasks
from v3d_torch.segmentation.yolo import YOLOSegmenter
from v3d_torch.types import Instances, RGBDFrame

__all__ = ["COCO_NAMES", "PERSON", "NoSegmentation", "StoredMasks", "YOLOSegmenter", "make_segmenter"]


def make_segmenter(
    config: SegmentationConfig, weights: Path | None = None, masks_dir: Path | None = None
) -> Callable[[RGBDFrame], Instances]:
    """The source of instances that the configuration names.

    Args:
        config: of the stage; ``source`` decides.
        weights: for the network, see `YOLOSegmenter`.
        masks_dir: folder of id images, see `StoredMasks`.

    Raises:
        ConfigError: if masks are to be read but no folder is given.
        WeightsError: if the network's weights cannot be had.
        InputError: if the folder holds no masks.
    """
    if config.source == "none":
        return NoSegmentation()
    if config.source == "masks":
        if masks_dir is None:
            raise ConfigError("segmentation.source=masks: name the folder of the id images with --masks")
        return StoredMasks(masks_dir)
    return YOLOSegmenter(config, weights)
