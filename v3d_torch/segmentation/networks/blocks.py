"""Convolutional blocks of the YOLO family, from YOLOv8 to YOLO26.

The blocks follow the published architecture tables. Submodules have the names that they have in the published weights
(``cv1``, ``m``, ...): tensors are loaded by name, and a difference in structure shows as a missing tensor. All blocks
take and return feature maps of shape :math:`(B, C, H, W)`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Conv(nn.Module):
    """Convolution, batch normalisation, SiLU.

    Args:
        inputs: Input channels.
        outputs: Output channels.
        kernel: Side of the kernel, cells; padding keeps the size of the map at stride 1.
        stride: Stride, cells.
        groups: Groups of channels; equal to ``inputs`` for a depthwise convolution.
        activate: True to apply SiLU, False for a linear output.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1, activate: bool = True
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=1e-3)
        self.act = nn.SiLU() if activate else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Filter, normalise, activate."""
        return self.act(self.bn(self.conv(x)))


class Bottleneck(nn.Module):
    """Two 3x3 convolutions, with or without a residual connection.

    Args:
        channels: Input and output channels.
        hidden: Channels between the two convolutions.
        shortcut: True to add the input to the output.
    """

    def __init__(self, channels: int, hidden: int, shortcut: bool) -> None:
        super().__init__()
        self.cv1 = Conv(channels, hidden, 3)
        self.cv2 = Conv(hidden, channels, 3)
        self.shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        """Apply both convolutions; add the input if configured."""
        y = self.cv2(self.cv1(x))
        return x + y if self.shortcut else y


class C2f(nn.Module):
    """Cross-stage block of YOLOv8: half of the channels pass through a chain of modules; all maps are joined.

    Args:
        inputs: Input channels.
        outputs: Output channels.
        hidden: Channels of each half.
        chain: Modules of the chain, each with ``hidden`` input and output channels.
    """

    def __init__(self, inputs: int, outputs: int, hidden: int, chain: list[nn.Module]) -> None:
        super().__init__()
        self.cv1 = Conv(inputs, 2 * hidden)
        self.cv2 = Conv((2 + len(chain)) * hidden, outputs)
        self.m = nn.ModuleList(chain)

    def forward(self, x: Tensor) -> Tensor:
        """Split the channels, apply the chain, join all maps."""
        maps = list(self.cv1(x).chunk(2, dim=1))
        for module in self.m:
            maps.append(module(maps[-1]))
        return self.cv2(torch.cat(maps, dim=1))


class C3k(nn.Module):
    """Cross-stage block with two parallel paths of half the width, one of them with two bottlenecks.

    Args:
        channels: Input and output channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = channels // 2
        self.cv1 = Conv(channels, hidden)
        self.cv2 = Conv(channels, hidden)
        self.cv3 = Conv(2 * hidden, channels)
        self.m = nn.Sequential(*(Bottleneck(hidden, hidden, shortcut=True) for _ in range(2)))

    def forward(self, x: Tensor) -> Tensor:
        """Apply both paths and join them."""
        return self.cv3(torch.cat([self.m(self.cv1(x)), self.cv2(x)], dim=1))


class SPPF(nn.Module):
    """Spatial pyramid pooling: three chained 5x5 max poolings with receptive fields of 5, 9 and 13 cells.

    Args:
        channels: Input and output channels.
        residual: True for the form of YOLO26: a residual connection, and a linear first convolution.
    """

    def __init__(self, channels: int, residual: bool = False) -> None:
        super().__init__()
        self.cv1 = Conv(channels, channels // 2, activate=not residual)
        self.cv2 = Conv(2 * channels, channels)
        self.m = nn.MaxPool2d(5, stride=1, padding=2)
        self.residual = residual

    def forward(self, x: Tensor) -> Tensor:
        """Join a feature map and its three pooled versions."""
        maps = [self.cv1(x)]
        for _ in range(3):
            maps.append(self.m(maps[-1]))
        y = self.cv2(torch.cat(maps, dim=1))
        return x + y if self.residual else y


class Concat(nn.Module):
    """Concatenation of feature maps of one size along the channels."""

    def forward(self, maps: list[Tensor]) -> Tensor:
        """Concatenate maps of shapes :math:`(B, C_i, H, W)`."""
        return torch.cat(maps, dim=1)
