"""Self-attention over the cells of a small feature map: the position-sensitive blocks of YOLO11 and YOLO26.

The block was introduced with YOLOv10 (Wang et al., NeurIPS 2024, Sec. 3.3). Names of submodules are the checkpoints'.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from v3d_torch.segmentation.networks.blocks import Conv

HEAD_CHANNELS = 64
"""Channels of a value; queries and keys have half."""


class Attention(nn.Module):
    """Multi-head attention among all cells, with a depthwise convolution of the values as the sense of place."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.heads = channels // HEAD_CHANNELS
        self.qkv = Conv(channels, 2 * channels, activate=False)
        self.proj = Conv(channels, channels, activate=False)
        self.pe = Conv(channels, channels, 3, groups=channels, activate=False)

    def forward(self, x: Tensor) -> Tensor:
        """Attend; shapes :math:`(B, C, H, W)` in and out."""
        batch, channels, height, width = x.shape
        key_channels = HEAD_CHANNELS // 2
        qkv = self.qkv(x).view(batch, self.heads, 2 * HEAD_CHANNELS, height * width)
        q, k, v = qkv.split([key_channels, key_channels, HEAD_CHANNELS], dim=2)  # each B x heads x C' x HW
        weights = (q.transpose(-2, -1) @ k * key_channels**-0.5).softmax(dim=-1)
        attended = (v @ weights.transpose(-2, -1)).view(batch, channels, height, width)
        return self.proj(attended + self.pe(v.reshape(batch, channels, height, width)))


class PSABlock(nn.Module):
    """Attention, then a feed-forward network of twice the width, each with the identity beside it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.attn = Attention(channels)
        self.ffn = nn.Sequential(Conv(channels, 2 * channels), Conv(2 * channels, channels, activate=False))

    def forward(self, x: Tensor) -> Tensor:
        """Shapes :math:`(B, C, H, W)` in and out."""
        x = x + self.attn(x)
        return x + self.ffn(x)


class C2PSA(nn.Module):
    """Half of the channels passes through attention, the other half goes past it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.cv1 = Conv(channels, channels)
        self.cv2 = Conv(channels, channels)
        self.m = nn.Sequential(PSABlock(channels // 2))

    def forward(self, x: Tensor) -> Tensor:
        """Shapes :math:`(B, C, H, W)` in and out."""
        past, through = self.cv1(x).chunk(2, dim=1)
        return self.cv2(torch.cat([past, self.m(through)], dim=1))
