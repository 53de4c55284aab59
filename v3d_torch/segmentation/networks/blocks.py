"""The convolutional blocks of the YOLO family, from YOLOv8 to YOLO26.

Written from the published architecture tables. Submodules carry the names of the published checkpoints (``cv1``,
``m``, ...), so that a checkpoint's tensors load by name and any difference in structure shows as a missing tensor.
All blocks take and return feature maps of shape :math:`(B, C, H, W)`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Conv(nn.Module):
    """Convolution, batch normalisation, SiLU.

    Args:
        inputs: channels in.
        outputs: channels out.
        kernel: side of the kernel; the padding keeps the size at stride 1.
        stride: step, pixels.
        groups: groups of channels; ``inputs`` makes the convolution depthwise.
        activate: whether SiLU follows.
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
    """Two 3x3 convolutions over a hidden width, with or without the identity beside them."""

    def __init__(self, channels: int, hidden: int, shortcut: bool) -> None:
        super().__init__()
        self.cv1 = Conv(channels, hidden, 3)
        self.cv2 = Conv(hidden, channels, 3)
        self.shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        """Residual of the two convolutions, or just them."""
        y = self.cv2(self.cv1(x))
        return x + y if self.shortcut else y


class C2f(nn.Module):
    """Cross-stage block of YOLOv8: half of the channels runs through a chain, and every link of it is kept.

    Args:
        inputs: channels in.
        outputs: channels out.
        hidden: channels of each half.
        chain: the links, each from ``hidden`` to ``hidden`` channels.
    """

    def __init__(self, inputs: int, outputs: int, hidden: int, chain: list[nn.Module]) -> None:
        super().__init__()
        self.cv1 = Conv(inputs, 2 * hidden)
        self.cv2 = Conv((2 + len(chain)) * hidden, outputs)
        self.m = nn.ModuleList(chain)

    def forward(self, x: Tensor) -> Tensor:
        """Split, run the chain, join all of its links."""
        links = list(self.cv1(x).chunk(2, dim=1))
        for link in self.m:
            links.append(link(links[-1]))
        return self.cv2(torch.cat(links, dim=1))


class C3k(nn.Module):
    """Cross-stage block with two bottlenecks on one of two parallel paths of half the width."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = channels // 2
        self.cv1 = Conv(channels, hidden)
        self.cv2 = Conv(channels, hidden)
        self.cv3 = Conv(2 * hidden, channels)
        self.m = nn.Sequential(*(Bottleneck(hidden, hidden, shortcut=True) for _ in range(2)))

    def forward(self, x: Tensor) -> Tensor:
        """Join the path with bottlenecks and the path without."""
        return self.cv3(torch.cat([self.m(self.cv1(x)), self.cv2(x)], dim=1))


class SPPF(nn.Module):
    """Spatial pyramid pooling: three chained 5x5 maxima see 5, 9 and 13 cells.

    Args:
        channels: channels in and out.
        residual: YOLO26's form, with the identity beside it and no activation at its entry.
    """

    def __init__(self, channels: int, residual: bool = False) -> None:
        super().__init__()
        self.cv1 = Conv(channels, channels // 2, activate=not residual)
        self.cv2 = Conv(2 * channels, channels)
        self.m = nn.MaxPool2d(5, stride=1, padding=2)
        self.residual = residual

    def forward(self, x: Tensor) -> Tensor:
        """Join the map and its three pooled versions."""
        maps = [self.cv1(x)]
        for _ in range(3):
            maps.append(self.m(maps[-1]))
        y = self.cv2(torch.cat(maps, dim=1))
        return x + y if self.residual else y


class Concat(nn.Module):
    """Feature maps of one size, joined along the channels."""

    def forward(self, maps: list[Tensor]) -> Tensor:
        """Join maps of shapes :math:`(B, C_i, H, W)`."""
        return torch.cat(maps, dim=1)
