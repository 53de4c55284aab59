"""YOLO11n-seg: YOLOv8 with thinner stages, attention at the coarsest level and depthwise class branches."""

from __future__ import annotations

from torch import nn

from v3d_torch.segmentation.networks.attention import C2PSA
from v3d_torch.segmentation.networks.blocks import SPPF, Bottleneck, C2f, C3k, Concat, Conv
from v3d_torch.segmentation.networks.graph import LayerGraph, Sources
from v3d_torch.segmentation.networks.head import Segment, depthwise_branch
from v3d_torch.segmentation.networks.prototypes import Proto


def yolo11n_seg() -> LayerGraph:
    """The nano model."""
    return LayerGraph(
        [
            *backbone(SPPF(256)),  # 0 - 10
            ((), nn.Upsample(scale_factor=2.0)),  # 11
            ((-1, 6), Concat()),  # 12
            ((), thin_stage(384, 128)),  # 13
            ((), nn.Upsample(scale_factor=2.0)),  # 14
            ((-1, 4), Concat()),  # 15
            ((), thin_stage(256, 64)),  # 16, stride 8
            ((), Conv(64, 64, 3, 2)),  # 17
            ((-1, 13), Concat()),  # 18
            ((), thin_stage(192, 128)),  # 19, stride 16
            ((), Conv(128, 128, 3, 2)),  # 20
            ((-1, 10), Concat()),  # 21
            ((), deep_stage(384, 256)),  # 22, stride 32
            ((16, 19, 22), Segment((64, 128, 256), Proto(64), bins=16, classifier=depthwise_branch)),  # 23
        ]
    )


def backbone(pooling: SPPF) -> list[tuple[Sources, nn.Module]]:
    """Layers 0 to 10, which YOLO26 shares up to its pooling."""
    return [
        ((), Conv(3, 16, 3, 2)),  # 0
        ((), Conv(16, 32, 3, 2)),  # 1
        ((), thin_stage(32, 64, hidden=16)),  # 2
        ((), Conv(64, 64, 3, 2)),  # 3
        ((), thin_stage(64, 128, hidden=32)),  # 4, stride 8
        ((), Conv(128, 128, 3, 2)),  # 5
        ((), deep_stage(128, 128)),  # 6, stride 16
        ((), Conv(128, 256, 3, 2)),  # 7
        ((), deep_stage(256, 256)),  # 8
        ((), pooling),  # 9
        ((), C2PSA(256)),  # 10, stride 32
    ]


def thin_stage(inputs: int, outputs: int, hidden: int | None = None) -> C2f:
    """C3k2 in its light form: one bottleneck of half the width; ``hidden`` is half of ``outputs`` unless said."""
    hidden = hidden or outputs // 2
    return C2f(inputs, outputs, hidden, [Bottleneck(hidden, hidden // 2, shortcut=True)])


def deep_stage(inputs: int, outputs: int) -> C2f:
    """C3k2 in its heavy form: one cross-stage block."""
    hidden = outputs // 2
    return C2f(inputs, outputs, hidden, [C3k(hidden)])
