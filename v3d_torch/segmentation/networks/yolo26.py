"""YOLO26n-seg: distances without distributions, prototypes from all levels, one prediction per object.

The published weights contain two sets of branches: one-to-many branches for training, and one-to-one branches, which
predict each object once and need no suppression. Only the one-to-one branches are built here.
"""

from __future__ import annotations

from torch import Tensor, nn

from v3d_torch.segmentation.networks.attention import PSABlock
from v3d_torch.segmentation.networks.blocks import SPPF, Bottleneck, C2f, Concat, Conv
from v3d_torch.segmentation.networks.graph import LayerGraph
from v3d_torch.segmentation.networks.head import Segment, depthwise_branch
from v3d_torch.segmentation.networks.prototypes import MultiScaleProto
from v3d_torch.segmentation.networks.yolo11 import backbone, heavy_stage


def yolo26n_seg() -> LayerGraph:
    """Build the nano model, with random weights."""
    channels = (64, 128, 256)
    return LayerGraph(
        [
            *backbone(SPPF(256, residual=True)),  # 0 - 10
            ((), nn.Upsample(scale_factor=2.0)),  # 11
            ((-1, 6), Concat()),  # 12
            ((), heavy_stage(384, 128)),  # 13
            ((), nn.Upsample(scale_factor=2.0)),  # 14
            ((-1, 4), Concat()),  # 15
            ((), heavy_stage(256, 64)),  # 16, stride 8
            ((), Conv(64, 64, 3, 2)),  # 17
            ((-1, 13), Concat()),  # 18
            ((), heavy_stage(192, 128)),  # 19, stride 16
            ((), Conv(128, 128, 3, 2)),  # 20
            ((-1, 10), Concat()),  # 21
            ((), C2f(384, 256, 128, [nn.Sequential(Bottleneck(128, 64, shortcut=True), PSABlock(128))])),  # 22
            ((16, 19, 22), Segment(channels, MultiScaleProto(channels), bins=1, classifier=depthwise_branch)),  # 23
        ]
    )


def one_to_one(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Replace the tensors of the one-to-many branches by those of the one-to-one branches.

    Args:
        tensors: Published parameters and buffers by name.

    Returns:
        Parameters and buffers by the names that they have in `yolo26n_seg`; the original ones are still included.
    """
    prefix = "one2one_"
    return tensors | {name.replace(prefix, ""): tensor for name, tensor in tensors.items() if prefix in name}
