"""Instance segmentation of colour images (paper, Sec. III-A)."""

from __future__ import annotations

from pathlib import Path

from v3d_torch.config import SegmentationConfig
from v3d_torch.errors import ConfigError
from v3d_torch.segmentation.coco import COCO_NAMES, PERSON
from v3d_torch.segmentation.mask_files import MaskFolder
from v3d_torch.segmentation.none import NoSegmentation
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.segmentation.yolo import YOLOSegmenter
from v3d_torch.types import Segmenter

__all__ = [
    "COCO_NAMES",
    "PERSON",
    "MaskFolder",
    "NoSegmentation",
    "UprightSegmenter",
    "YOLOSegmenter",
    "keep_upright",
    "make_instance_source",
    "make_segmenter",
]


def make_segmenter(config: SegmentationConfig, weights: Path | None = None, masks_dir: Path | None = None) -> Segmenter:
    """The source of instances that the configuration names, for one run: it follows the camera's roll.

    See `make_instance_source` for arguments and errors.
    """
    return keep_upright(make_instance_source(config, weights, masks_dir), config)


def keep_upright(source: Segmenter, config: SegmentationConfig) -> Segmenter:
    """A network that is shown upright images where the configuration says so; masks from files are as they are."""
    return UprightSegmenter(source) if config.upright and config.source == "yolo" else source


def make_instance_source(
    config: SegmentationConfig, weights: Path | None = None, masks_dir: Path | None = None
) -> Segmenter:
    """The source of instances, one image like another.

    Args:
        config: of the stage; ``source`` decides.
        weights: for the network, see `YOLOSegmenter`.
        masks_dir: folder of id images, see `MaskFolder`.

    Raises:
        ConfigError: if masks are to be read but no folder is given, or what is given is not what is to be used.
        WeightsError: if the network's weights cannot be had.
        InputError: if the folder holds no masks.
    """
    for option, given, source in (("weights", weights, "yolo"), ("masks", masks_dir, "masks")):
        if given is not None and config.source != source:
            raise ConfigError(
                f"--{option} {given}: means nothing to segmentation.source={config.source}; leave it out, or give"
                f" --segmenter {source}"
            )
    if config.source == "none":
        return NoSegmentation()
    if config.source == "masks":
        if masks_dir is None:
            raise ConfigError("segmentation.source=masks: name the folder of the id images with --masks")
        return MaskFolder(masks_dir)
    return YOLOSegmenter(config, weights)
