"""Selection of the largest clusters of a point cloud (paper, Sec. III-B.2)."""

from __future__ import annotations

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor


def largest_clusters(labels: Tensor, valid: Tensor, n: int | Tensor = 1, min_points: int = 1) -> Tensor:
    """Select the points of the ``n`` largest clusters of every cloud.

    The paper keeps as many clusters of a scene as it recognises instances. With one cloud per instance, that is the
    largest cluster of each cloud, ``n=1``.

    Args:
        labels: Cluster of each point, -1 = noise, int64, shape :math:`(B, N)`.
        valid: Mask of the points that are not padding, bool, shape :math:`(B, N)`.
        n: Number of clusters to keep, one number for all clouds or int64 of shape :math:`(B,)`. Of two clusters of the
            same size, the one with the lower label ranks first.
        min_points: Minimum number of points of a cluster that is kept.

    Returns:
        Mask of the points of the selected clusters, bool, shape :math:`(B, N)`.
    """
    KORNIA_CHECK_SHAPE(labels, ["B", "N"])
    KORNIA_CHECK_SHAPE(valid, [str(size) for size in labels.shape])
    if labels.numel() == 0:
        return torch.zeros_like(valid)
    clustered = valid & (labels >= 0)
    cluster = torch.where(clustered, labels, 0)
    size = labels.new_zeros(labels.shape[0], int(cluster.max()) + 1).scatter_add_(1, cluster, clustered.to(torch.int64))
    order = size.argsort(dim=1, descending=True, stable=True)
    rank = torch.empty_like(order).scatter_(1, order, torch.arange(order.shape[1]).expand_as(order))
    selected = (rank < torch.as_tensor(n).reshape(-1, 1)) & (size >= min_points)
    return clustered & selected.gather(1, cluster)


class LargestClusters(torch.nn.Module):
    """:func:`largest_clusters` as a module.

    Args:
        min_points: Minimum number of points of a cluster that is kept.
    """

    def __init__(self, min_points: int = 1) -> None:
        super().__init__()
        self.min_points = min_points

    def forward(self, labels: Tensor, valid: Tensor, n: int | Tensor = 1) -> Tensor:
        """Select the ``n`` largest clusters of labels :math:`(B, N)`; see :func:`largest_clusters`."""
        return largest_clusters(labels, valid, n, self.min_points)
