"""Figure of outlier rejection: point clouds of objects before and after it, like a figure of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from v3d_torch.viz.figure_output import save_figure

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

BLACK = (0.0, 0.0, 0.0, 1.0)
"""Colour of the rejected points, RGBA."""

_MAX_POINTS = 3000  # drawn per cloud, evenly sampled; more points only hide the clouds behind
_BORDER = 0.05  # metres around the points


@dataclass(frozen=True)
class Cluster:
    """Point cloud of an object before and after outlier rejection, camera frame, metres.

    Attributes:
        label: Label of the object, such as "person 3".
        before: Points of all pixels of the mask, shape :math:`(N, 3)`.
        inliers: True for points that are not outliers, bool, shape :math:`(N,)`.
        after: Voxel means of the inliers, shape :math:`(M, 3)`.
    """

    label: str
    before: Tensor
    inliers: Tensor
    after: Tensor


def save_clusters_figure(clusters: Sequence[Cluster], path: Path, title: str = "") -> None:
    """Write a figure of outlier rejection to a file, see `draw_clusters`.

    Args:
        clusters: Clouds of the objects, at least one.
        path: Image file; the suffix (.png, .pdf, .svg) selects the format.
        title: Title of the figure.

    Raises:
        OutputError: If the file cannot be written.
        ValueError: If there is no cloud.
    """
    save_figure(draw_clusters(clusters, title), path)


def draw_clusters(clusters: Sequence[Cluster], title: str = "") -> Figure:
    """Draw clouds before outlier rejection, with the rejected points in black, and after it, from above the camera.

    Args:
        clusters: Clouds of the objects, at least one.
        title: Title of the figure.

    Raises:
        ValueError: If there is no cloud.
    """
    if not clusters:
        raise ValueError("a figure of clusters needs at least one cluster")
    colours = [colormaps["tab20"](2 * i % 20 + i // 10 % 2) for i in range(len(clusters))]  # saturated colours first
    figure = Figure(figsize=(11.0, 5.8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    before = cast("Axes3D", figure.add_subplot(1, 2, 1, projection="3d"))
    after = cast("Axes3D", figure.add_subplot(1, 2, 2, projection="3d"))
    for cluster, colour in zip(clusters, colours, strict=True):
        _draw_points(before, cluster.before[cluster.inliers], colour, 1.0)
        _draw_points(before, cluster.before[~cluster.inliers], BLACK, 2.0)
        _draw_points(after, cluster.after, colour, 2.0)
    points = sum(len(cluster.before) for cluster in clusters)
    rejected = sum(int((~cluster.inliers).sum()) for cluster in clusters)
    before.set_title(f"before outlier rejection: {points} points, {rejected} rejected")
    after.set_title(f"after outlier rejection: {sum(len(cluster.after) for cluster in clusters)} voxels")
    _set_views([before, after], torch.cat([cluster.before for cluster in clusters]))
    figure.suptitle(title)
    entries = zip([*(cluster.label for cluster in clusters), "rejected"], [*colours, BLACK], strict=True)
    handles = [
        Line2D([], [], color=colour, label=label, marker="o", linestyle="none", markersize=5)
        for label, colour in entries
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    return figure


def _draw_points(axes: Axes3D, points: Tensor, colour: tuple[float, float, float, float], size: float) -> None:
    x, y, z = points[:: max(1, -(-len(points) // _MAX_POINTS))].T.numpy()
    axes.scatter(x, z, -y, s=size, color=[colour], linewidths=0, depthshade=False)  # y points down in the camera frame


def _set_views(panels: Sequence[Axes3D], points: Tensor) -> None:
    """Set the same view for all panels, with equal scales, that contains all points."""
    low, high = (points.amin(dim=0) - _BORDER).tolist(), (points.amax(dim=0) + _BORDER).tolist()
    for axes in panels:
        axes.set(xlabel="x [m]", ylabel="z (depth) [m]", zlabel="-y (up) [m]")
        axes.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), zlim=(-high[1], -low[1]))
        axes.set_aspect("equal", adjustable="box")
        axes.set_box_aspect(None, zoom=1.05)
        axes.view_init(elev=18, azim=-75)
        axes.locator_params(nbins=5)
