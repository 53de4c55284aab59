"""Self-attention over the cells of a feature map: the position-sensitive blocks of YOLO11 and YOLO26.

Source: partial self-attention of YOLOv10 (Wang et al., NeurIPS 2024, Sec. 3.3). Submodules have the names that they
have in the published weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from v3d_torch.segmentation.networks.blocks import Conv

HEAD_CHANNELS = 64
"""Channels of the values of one head; queries and keys have half as many."""


class Attention(nn.Module):
    """Multi-head attention between all cells, with a depthwise convolution of the values as position encoding.

    Args:
        channels: Input and output channels, a multiple of `HEAD_CHANNELS`.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.heads = channels // HEAD_CHANNELS
        self.qkv = Conv(channels, 2 * channels, activate=False)
        self.proj = Conv(channels, channels, activate=False)
        self.pe = Conv(channels, channels, 3, groups=channels, activate=False)

    def forward(self, x: Tensor) -> Tensor:
        """Apply attention to a feature map of shape :math:`(B, C, H, W)`; the shape stays the same."""
        batch, channels, height, width = x.shape
        key_channels = HEAD_CHANNELS // 2
        qkv = self.qkv(x).view(batch, self.heads, 2 * HEAD_CHANNELS, height * width)
        q, k, v = qkv.split([key_channels, key_channels, HEAD_CHANNELS], dim=2)  # each B x heads x C' x HW
        weights = (q.transpose(-2, -1) @ k * key_channels**-0.5).softmax(dim=-1)
        attended = (v @ weights.transpose(-2, -1)).view(batch, channels, height, width)
        return self.proj(attended + self.pe(v.reshape(batch, channels, height, width)))


class PSABlock(nn.Module):
    """Attention, then a feed-forward network of twice the width, each with a residual connection.

    Args:
        channels: Input and output channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.attn = Attention(channels)
        self.ffn = nn.Sequential(Conv(channels, 2 * channels), Conv(2 * channels, channels, activate=False))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block to a feature map of shape :math:`(B, C, H, W)`; the shape stays the same."""
        x = x + self.attn(x)
        return x + self.ffn(x)


class C2PSA(nn.Module):
    """Cross-stage block: attention on one half of the channels, the identity on the other half.

    Args:
        channels: Input and output channels.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.cv1 = Conv(channels, channels)
        self.cv2 = Conv(channels, channels)
        self.m = nn.Sequential(PSABlock(channels // 2))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block to a feature map of shape :math:`(B, C, H, W)`; the shape stays the same."""
        bypass, attended = self.cv1(x).chunk(2, dim=1)
        return self.cv2(torch.cat([bypass, self.m(attended)], dim=1))
