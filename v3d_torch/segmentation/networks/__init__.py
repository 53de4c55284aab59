"""YOLO segmentation networks as plain torch modules."""

from __future__ import annotations

from v3d_torch.segmentation.networks.graph import LayerGraph
from v3d_torch.segmentation.networks.yolo11 import yolo11n_seg
from v3d_torch.segmentation.networks.yolo26 import one_to_one, yolo26n_seg
from v3d_torch.segmentation.networks.yolov8 import yolov8n_seg

__all__ = ["LayerGraph", "one_to_one", "yolo11n_seg", "yolo26n_seg", "yolov8n_seg"]
