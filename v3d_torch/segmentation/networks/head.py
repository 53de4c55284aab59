"""Segmentation head: boxes, class scores, mask coefficients and prototypes from a three-level feature pyramid."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from v3d_torch.segmentation.coco import COCO_NAMES
from v3d_torch.segmentation.networks.blocks import Conv
from v3d_torch.segmentation.networks.prototypes import PROTOTYPES

STRIDES = (8, 16, 32)
"""Side of a cell of each pyramid level, pixels of the network input, from the finest level to the coarsest."""

CLASSES = len(COCO_NAMES)


class DFL(nn.Module):
    """Expected value of a distance that is predicted as a distribution over bins.

    Source: distribution focal loss (Li et al., NeurIPS 2020).

    Args:
        bins: Number of bins.
    """

    def __init__(self, bins: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(bins, 1, 1, bias=False)  # the weights are the bin values 0, ..., bins - 1
        self.bins = bins

    def forward(self, logits: Tensor) -> Tensor:
        """Convert logits of shape :math:`(B, 4 bins, N)` to distances of shape :math:`(B, 4, N)`."""
        batch, _, cells = logits.shape
        # The bins are the last dimension, because onnxruntime is slow for a softmax over any other. It is also slow for
        # the product of a matrix and a short vector, hence the explicit sum.
        distribution = logits.view(batch, 4, self.bins, cells).transpose(2, 3).softmax(dim=3)
        return (distribution * self.conv.weight.view(self.bins)).sum(dim=3)


def dense_branch(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two 3x3 convolutions and a linear 1x1 convolution."""
    return nn.Sequential(Conv(inputs, hidden, 3), Conv(hidden, hidden, 3), nn.Conv2d(hidden, outputs, 1))


def depthwise_branch(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two depthwise separable 3x3 convolutions and a linear 1x1 convolution, as in YOLO11."""
    return nn.Sequential(
        nn.Sequential(Conv(inputs, inputs, 3, groups=inputs), Conv(inputs, hidden)),
        nn.Sequential(Conv(hidden, hidden, 3, groups=hidden), Conv(hidden, hidden)),
        nn.Conv2d(hidden, outputs, 1),
    )


class Segment(nn.Module):
    """Anchor-free head with one branch per level for boxes (``cv2``), classes (``cv3``), mask coefficients (``cv4``).

    Args:
        channels: Channels of the pyramid levels, finest first.
        proto: Module that computes the prototypes.
        bins: Number of bins for the distance to each side of a box; 1 if the distance itself is predicted.
        classifier: Function that creates the class branch of a level from its input, hidden and output channels.
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
        """Predict one box per cell of each level.

        Args:
            pyramid: Feature maps at strides 8, 16 and 32, shapes :math:`(B, C_i, H/s, W/s)`.

        Returns:
            Predictions, shape :math:`(B, 4 + 80 + 32, N)`: centre and size of the box in pixels of the network input,
            class scores in [0, 1], mask coefficients; and prototypes, shape :math:`(B, 32, H/4, W/4)`.
        """
        # Distances from the cell centre to the left, top, right and bottom edge of the box, in strides.
        distances = self.dfl(_apply_branches(self.cv2, pyramid))  # B x 4 x N
        scores = _apply_branches(self.cv3, pyramid).sigmoid()
        coefficients = _apply_branches(self.cv4, pyramid)
        centres, strides = _cell_grid(pyramid)
        to_left_top, to_right_bottom = distances.chunk(2, dim=1)
        boxes = torch.cat([centres + (to_right_bottom - to_left_top) / 2, to_left_top + to_right_bottom], dim=1)
        boxes = boxes * strides
        return torch.cat([boxes, scores, coefficients], dim=1), self.proto(pyramid)


def _apply_branches(branches: nn.ModuleList, pyramid: list[Tensor]) -> Tensor:
    """Apply to each level its branch and join the cells of all levels, shape (B, C, N)."""
    return torch.cat([branch(level).flatten(2) for branch, level in zip(branches, pyramid, strict=True)], dim=2)


def _cell_grid(pyramid: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Centres (x, y) of all cells in units of their stride, shape (2, N), and the strides in pixels, shape (N,)."""
    centres, strides = [], []
    for level, stride in zip(pyramid, STRIDES, strict=True):
        height, width = (int(size) for size in level.shape[2:])  # Python numbers become constants in the export
        rows, columns = torch.arange(height, dtype=level.dtype), torch.arange(width, dtype=level.dtype)
        y, x = torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
        centres.append(torch.stack([x, y]).flatten(1))
        strides.append(torch.full((height * width,), float(stride), dtype=level.dtype))
    return torch.cat(centres, dim=1), torch.cat(strides)
