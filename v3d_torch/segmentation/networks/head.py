"""The segmentation head: boxes, class scores, mask coefficients and prototypes from a three-level pyramid."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from v3d_torch.segmentation.coco import COCO_NAMES
from v3d_torch.segmentation.networks.blocks import Conv
from v3d_torch.segmentation.networks.prototypes import PROTOTYPES

STRIDES = (8, 16, 32)
"""Pixels of the image per cell, from the finest level to the coarsest."""

CLASSES = len(COCO_NAMES)


class DFL(nn.Module):
    """Expected value of a distance that is predicted as a distribution over bins (Li et al., NeurIPS 2020)."""

    def __init__(self, bins: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(bins, 1, 1, bias=False)  # its weights are the bins' values, 0 .. bins - 1
        self.bins = bins

    def forward(self, logits: Tensor) -> Tensor:
        """Logits of shape :math:`(B, 4 bins, N)` to distances of shape :math:`(B, 4, N)`."""
        batch, _, cells = logits.shape
        # Bins side by side in memory: onnxruntime takes eight times as long over any other dimension; and ten times as
        # long for a product of a matrix with so short a vector as for this sum.
        distribution = logits.view(batch, 4, self.bins, cells).transpose(2, 3).softmax(dim=3)
        return (distribution * self.conv.weight.view(self.bins)).sum(dim=3)


def dense_branch(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two 3x3 convolutions and a linear layer per cell."""
    return nn.Sequential(Conv(inputs, hidden, 3), Conv(hidden, hidden, 3), nn.Conv2d(hidden, outputs, 1))


def depthwise_branch(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """The same with each 3x3 convolution split into a depthwise and a pointwise one (YOLO11)."""
    return nn.Sequential(
        nn.Sequential(Conv(inputs, inputs, 3, groups=inputs), Conv(inputs, hidden)),
        nn.Sequential(Conv(hidden, hidden, 3, groups=hidden), Conv(hidden, hidden)),
        nn.Conv2d(hidden, outputs, 1),
    )


class Segment(nn.Module):
    """Anchor-free head with one branch per level for boxes (``cv2``), classes (``cv3``), mask coefficients (``cv4``).

    Args:
        channels: channels of the pyramid's levels.
        proto: makes the prototypes.
        bins: bins of each distance to a box side; 1 means the distance itself.
        classifier: makes the class branch of a level.
    """

    def __init__(
        self,
        channels: tuple[int, int, int],
        proto: nn.Module,
        bins: int,
        classifier: Callable[[int, int, int], nn.Module],
    ) -> None:
        super().__init__()
        self.cv2 = nn.ModuleList([dense_branch(level, 4 * max(bins, 4), 4 * bins) for level in channels])
        self.cv3 = nn.ModuleList([classifier(level, CLASSES, CLASSES) for level in channels])
        self.cv4 = nn.ModuleList([dense_branch(level, PROTOTYPES, PROTOTYPES) for level in channels])
        self.dfl: nn.Module = DFL(bins) if bins > 1 else nn.Identity()
        self.proto = proto

    def forward(self, pyramid: list[Tensor]) -> tuple[Tensor, Tensor]:
        """All predictions, one per cell of each level.

        Args:
            pyramid: maps at strides 8, 16 and 32, shapes :math:`(B, C_i, H/s, W/s)`.

        Returns:
            Predictions of shape :math:`(B, 4 + 80 + 32, N)`: centre and size of the box in pixels, class scores in
            [0, 1], mask coefficients; and prototypes of shape :math:`(B, 32, H/4, W/4)`.
        """
        distances = self.dfl(_cells(self.cv2, pyramid))  # B x 4 x N: left, top, right, bottom of the cell's centre
        scores = _cells(self.cv3, pyramid).sigmoid()
        coefficients = _cells(self.cv4, pyramid)
        centres, strides = _grid(pyramid)
        before, after = distances.chunk(2, dim=1)
        boxes = torch.cat([centres + (after - before) / 2, before + after], dim=1) * strides
        return torch.cat([boxes, scores, coefficients], dim=1), self.proto(pyramid)


def _cells(branches: nn.ModuleList, pyramid: list[Tensor]) -> Tensor:
    """Each level through its branch, cells in a row: shape :math:`(B, C, N)`."""
    return torch.cat([branch(level).flatten(2) for branch, level in zip(branches, pyramid, strict=True)], dim=2)


def _grid(pyramid: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Centres of all cells in units of their stride, shape :math:`(2, N)`, and the strides, shape :math:`(N,)`."""
    centres, strides = [], []
    for level, stride in zip(pyramid, STRIDES, strict=True):
        height, width = (int(size) for size in level.shape[2:])  # plain numbers, so that an export holds constants
        rows, columns = torch.arange(height, dtype=level.dtype), torch.arange(width, dtype=level.dtype)
        y, x = torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
        centres.append(torch.stack([x, y]).flatten(1))
        strides.append(torch.full((height * width,), float(stride), dtype=level.dtype))
    return torch.cat(centres, dim=1), torch.cat(strides)
