"""Selection of the largest clusters of a point cloud (paper, Sec. III-B.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_counts, check_masks, check_shape
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels.compiler import can_read


def largest_clusters(labels: Tensor, valid: Tensor, n: int | Tensor = 1, min_points: int = 1) -> Tensor:
    """Select the points of the ``n`` largest clusters of every cloud.

    The paper keeps as many clusters of a scene as it recognises instances. With one cloud per instance, that is the
    largest cluster of each cloud, ``n=1``.

    Args:
        labels: Cluster of each point, below N, -1 = noise, int64, shape :math:`(B, N)`; see :func:`dbscan`.
        valid: Mask of the points that are not padding, bool, shape :math:`(B, N)`.
        n: Number of clusters to keep, one number for all clouds or int64 of shape :math:`(B,)`. Of two clusters of the
            same size, the one with the lower label ranks first.
        min_points: Minimum number of points of a cluster that is kept.

    Returns:
        Mask of the points of the selected clusters, bool, shape :math:`(B, N)`.

    Raises:
        InputError: If ``valid`` is not bool, or ``labels`` are not int64.
        ConfigError: If ``n`` or ``min_points`` is a number that is negative or not whole.
    """
    if not isinstance(n, Tensor):
        check_counts(n=n)
    check_counts(min_points=min_points)
    check_masks(valid=valid)
    if labels.dtype != torch.int64:
        raise InputError(f"labels has the type {labels.dtype}; give labels of type torch.int64")
    check_shape("labels", labels, "B", "N")
    check_shape("valid", valid, *labels.shape)
    if labels.numel() == 0:
        return torch.zeros_like(valid)
    clustered = valid & (labels >= 0)
    cluster = torch.where(clustered, labels, 0)
    count = int(cluster.max()) + 1 if can_read(cluster) else labels.shape[1]
    size = labels.new_zeros(labels.shape[0], count).scatter_add(1, cluster, clustered.to(torch.int64))
    order = size.argsort(dim=1, descending=True, stable=True)
    place = torch.arange(count, device=labels.device).expand_as(order)
    rank = torch.zeros_like(order).scatter(1, order, place)
    most = n.reshape(-1, 1) if isinstance(n, Tensor) else n
    selected = (rank < most) & (size >= min_points)
    return clustered & selected.gather(1, cluster)


class LargestClusters(SettingsModule):
    """:func:`largest_clusters` as a module.

    Args:
        min_points: Minimum number of points of a cluster that is kept.

    Raises:
        ConfigError: If a number is not possible; see :func:`largest_clusters`.
    """

    def __init__(self, min_points: int = 1) -> None:
        check_counts(min_points=min_points)
        super().__init__()
        self.min_points = min_points

    def forward(self, labels: Tensor, valid: Tensor, n: int | Tensor = 1) -> Tensor:
        """Select the ``n`` largest clusters of labels :math:`(B, N)`; see :func:`largest_clusters`."""
        return largest_clusters(labels, valid, n, self.min_points)
