"""YOLOv8n-seg, the network of the paper (Sec. III-A)."""

from __future__ import annotations

from torch import nn

from v3d_torch.segmentation.networks.blocks import SPPF, Bottleneck, C2f, Concat, Conv
from v3d_torch.segmentation.networks.graph import LayerGraph
from v3d_torch.segmentation.networks.head import Segment, dense_branch
from v3d_torch.segmentation.networks.prototypes import Proto


def yolov8n_seg() -> LayerGraph:
    """Build the nano model, with random weights: C2f backbone, top-down and bottom-up pyramid, head with `DFL`."""
    return LayerGraph(
        [
            ((), Conv(3, 16, 3, 2)),  # 0
            ((), Conv(16, 32, 3, 2)),  # 1
            ((), _stage(32, 32, 1)),  # 2
            ((), Conv(32, 64, 3, 2)),  # 3
            ((), _stage(64, 64, 2)),  # 4, stride 8
            ((), Conv(64, 128, 3, 2)),  # 5
            ((), _stage(128, 128, 2)),  # 6, stride 16
            ((), Conv(128, 256, 3, 2)),  # 7
            ((), _stage(256, 256, 1)),  # 8
            ((), SPPF(256)),  # 9, stride 32
            ((), nn.Upsample(scale_factor=2.0)),  # 10
            ((-1, 6), Concat()),  # 11
            ((), _stage(384, 128, 1, shortcut=False)),  # 12
            ((), nn.Upsample(scale_factor=2.0)),  # 13
            ((-1, 4), Concat()),  # 14
            ((), _stage(192, 64, 1, shortcut=False)),  # 15, stride 8
            ((), Conv(64, 64, 3, 2)),  # 16
            ((-1, 12), Concat()),  # 17
            ((), _stage(192, 128, 1, shortcut=False)),  # 18, stride 16
            ((), Conv(128, 128, 3, 2)),  # 19
            ((-1, 9), Concat()),  # 20
            ((), _stage(384, 256, 1, shortcut=False)),  # 21, stride 32
            ((15, 18, 21), Segment((64, 128, 256), Proto(64), bins=16, classifier=dense_branch)),  # 22
        ]
    )


def _stage(inputs: int, outputs: int, depth: int, shortcut: bool = True) -> C2f:
    """C2f block with a chain of bottlenecks."""
    hidden = outputs // 2
    return C2f(inputs, outputs, hidden, [Bottleneck(hidden, hidden, shortcut) for _ in range(depth)])
