"""YOLO11n-seg: YOLOv8 with lighter stages, attention at the coarsest level and depthwise class branches."""

from __future__ import annotations

from torch import nn

from v3d_torch.segmentation.networks.attention import C2PSA
from v3d_torch.segmentation.networks.blocks import SPPF, Bottleneck, C2f, C3k, Concat, Conv
from v3d_torch.segmentation.networks.graph import LayerGraph, Sources
from v3d_torch.segmentation.networks.head import Segment, depthwise_branch
from v3d_torch.segmentation.networks.prototypes import Proto


def yolo11n_seg() -> LayerGraph:
    """Build the nano model, with random weights."""
    return LayerGraph(
        [
            *backbone(SPPF(256)),  # 0 - 10
            ((), nn.Upsample(scale_factor=2.0)),  # 11
            ((-1, 6), Concat()),  # 12
            ((), light_stage(384, 128)),  # 13
            ((), nn.Upsample(scale_factor=2.0)),  # 14
            ((-1, 4), Concat()),  # 15
            ((), light_stage(256, 64)),  # 16, stride 8
            ((), Conv(64, 64, 3, 2)),  # 17
            ((-1, 13), Concat()),  # 18
            ((), light_stage(192, 128)),  # 19, stride 16
            ((), Conv(128, 128, 3, 2)),  # 20
            ((-1, 10), Concat()),  # 21
            ((), heavy_stage(384, 256)),  # 22, stride 32
            ((16, 19, 22), Segment((64, 128, 256), Proto(64), bins=16, classifier=depthwise_branch)),  # 23
        ]
    )


def backbone(pooling: SPPF) -> list[tuple[Sources, nn.Module]]:
    """Layers 0 to 10 of YOLO11 and YOLO26, which differ only in the pooling module."""
    return [
        ((), Conv(3, 16, 3, 2)),  # 0
        ((), Conv(16, 32, 3, 2)),  # 1
        ((), light_stage(32, 64, hidden=16)),  # 2
        ((), Conv(64, 64, 3, 2)),  # 3
        ((), light_stage(64, 128, hidden=32)),  # 4, stride 8
        ((), Conv(128, 128, 3, 2)),  # 5
        ((), heavy_stage(128, 128)),  # 6, stride 16
        ((), Conv(128, 256, 3, 2)),  # 7
        ((), heavy_stage(256, 256)),  # 8
        ((), pooling),  # 9
        ((), C2PSA(256)),  # 10, stride 32
    ]


def light_stage(inputs: int, outputs: int, hidden: int | None = None) -> C2f:
    """C3k2 block in its light form, with one bottleneck; ``hidden`` is half of ``outputs`` by default."""
    hidden = hidden or outputs // 2
    return C2f(inputs, outputs, hidden, [Bottleneck(hidden, hidden // 2, shortcut=True)])


def heavy_stage(inputs: int, outputs: int) -> C2f:
    """C3k2 block in its heavy form, with one C3k block."""
    hidden = outputs // 2
    return C2f(inputs, outputs, hidden, [C3k(hidden)])
