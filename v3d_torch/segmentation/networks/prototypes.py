"""Mask prototypes: images whose linear combinations are instance masks (YOLACT, Bolya et al., ICCV 2019)."""

from __future__ import annotations

from torch import Tensor, nn

from v3d_torch.segmentation.networks.blocks import Conv

PROTOTYPES = 32
"""Number of prototypes, and of mask coefficients of each prediction."""

_HIDDEN = 64
"""Number of hidden channels."""


class Proto(nn.Module):
    """Prototypes at a quarter of the input size, from the finest level of the pyramid.

    Args:
        channels: Channels of the finest level.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.cv1 = Conv(channels, _HIDDEN, 3)
        self.upsample = nn.ConvTranspose2d(_HIDDEN, _HIDDEN, 2, 2)
        self.cv2 = Conv(_HIDDEN, _HIDDEN, 3)
        self.cv3 = Conv(_HIDDEN, PROTOTYPES)

    def forward(self, pyramid: list[Tensor]) -> Tensor:
        """Compute prototypes, shape :math:`(B, 32, H/4, W/4)`, from maps at strides 8, 16 and 32."""
        return self.cv3(self.cv2(self.upsample(self.cv1(pyramid[0]))))


class MultiScaleProto(Proto):
    """Prototypes of YOLO26, from the sum of the finest level and the upsampled coarser levels.

    Args:
        channels: Channels of the pyramid levels, finest first.
    """

    def __init__(self, channels: tuple[int, int, int]) -> None:
        super().__init__(channels[0])
        self.feat_refine = nn.ModuleList([Conv(coarse, channels[0]) for coarse in channels[1:]])
        self.feat_fuse = Conv(channels[0], channels[0], 3)

    def forward(self, pyramid: list[Tensor]) -> Tensor:
        """Compute prototypes, shape :math:`(B, 32, H/4, W/4)`, from maps at strides 8, 16 and 32."""
        finest, *coarser = pyramid
        fused = finest
        for level, refine, coarse in zip((1, 2), self.feat_refine, coarser, strict=True):
            fused = fused + nn.functional.interpolate(refine(coarse), scale_factor=float(2**level), mode="nearest")
        return super().forward([self.feat_fuse(fused)])
