"""Instance segmentation of colour images (paper, Sec. III-A)."""

from __future__ import annotations

from v3d_torch.segmentation.coco import COCO_NAMES, PERSON
from v3d_torch.segmentation.factory import NoSegmentation, make_instance_source, make_segmenter, wrap_upright
from v3d_torch.segmentation.mask_files import MaskFolder
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.segmentation.yolo import YOLOSegmenter

__all__ = [
    "COCO_NAMES",
    "PERSON",
    "MaskFolder",
    "NoSegmentation",
    "UprightSegmenter",
    "YOLOSegmenter",
    "make_instance_source",
    "make_segmenter",
    "wrap_upright",
]
