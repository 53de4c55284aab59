"""Segmentation head: boxes, class scores, mask coefficients and prototypes from a three-level feature pyramid."""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
        # The bins are the last dimension, because onnxruntime is slow for a softmax over any other. It is also slow for
        # the product of a matrix and a short vector, hence the explicit sum.
        distribution = logits.unflatten(1, (4, self.bins)).transpose(2, 3).softmax(dim=3)
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
        boxes = boxes_from_distances(self.distances(pyramid), *cell_grid([level.shape[2:] for level in pyramid]))
        return torch.cat([boxes, self.scores(pyramid), self.coefficients(pyramid)], dim=1), self.proto(pyramid)

    def distances(self, pyramid: list[Tensor]) -> Tensor:
        """Distances from the cell centre to the left, top, right and bottom edge, in strides, shape (B, 4, N)."""
        distances: Tensor = self.dfl(_apply_branches(self.cv2, pyramid))
        return distances

    def scores(self, pyramid: list[Tensor]) -> Tensor:
        """Class scores in [0, 1], shape (B, 80, N)."""
        return _apply_branches(self.cv3, pyramid).sigmoid()

    def coefficients(self, pyramid: list[Tensor]) -> Tensor:
        """Mask coefficients, shape (B, 32, N)."""
        return _apply_branches(self.cv4, pyramid)


def boxes_from_distances(distances: Tensor, centres: Tensor, strides: Tensor) -> Tensor:
    """Centre and size of boxes, pixels of the network input.

    Args:
        distances: Distances from the cell centre to the left, top, right and bottom edge, in strides, shape
            :math:`(B, 4, N)`.
        centres: Centres (x, y) of the cells in units of their stride, shape :math:`(2, N)`.
        strides: Strides of the cells, pixels, shape :math:`(N,)`.

    Returns:
        Centre x, centre y, width and height, shape :math:`(B, 4, N)`.
    """
    to_left_top, to_right_bottom = distances.chunk(2, dim=1)
    boxes = torch.cat([centres + (to_right_bottom - to_left_top) / 2, to_left_top + to_right_bottom], dim=1)
    return boxes * strides


def cell_grid(sizes: Sequence[Sequence[int]]) -> tuple[Tensor, Tensor]:
    """Centres (x, y) of all cells in units of their stride, shape (2, N), and the strides in pixels, shape (N,).

    Args:
        sizes: Rows and columns of each pyramid level, finest first.
    """
    centres, strides = [], []
    for size, stride in zip(sizes, STRIDES, strict=True):
        height, width = map(int, size)  # Python numbers become constants in the export
        rows, columns = (torch.arange(count, dtype=torch.float32) + 0.5 for count in (height, width))
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        centres.append(torch.stack([x, y]).flatten(1))
        strides.append(torch.full((height * width,), stride, dtype=torch.float32))
    return torch.cat(centres, dim=1), torch.cat(strides)


def _apply_branches(branches: nn.ModuleList, pyramid: list[Tensor]) -> Tensor:
    """Apply to each level its branch and join the cells of all levels, shape (B, C, N)."""
    return torch.cat([branch(level).flatten(2) for branch, level in zip(branches, pyramid, strict=True)], dim=2)
