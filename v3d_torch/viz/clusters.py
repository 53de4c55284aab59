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

_OTHERS = (0.88, 0.88, 0.88, 1.0)  # colour of the objects without a colour of their own, RGBA
_MAX_COLOURS = 20  # of the palette: more objects cannot be told apart
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

    Of more than 20 objects, the 20 with the most points have a colour and a name; the others are light grey.

    Args:
        clusters: Clouds of the objects, at least one.
        title: Title of the figure.

    Raises:
        ValueError: If there is no cloud.
    """
    if not clusters:
        raise ValueError("a figure of clusters needs at least one cluster")
    largest = sorted(range(len(clusters)), key=lambda i: -len(clusters[i].before))[:_MAX_COLOURS]
    named = {
        i: colormaps["tab20"](2 * rank % 20 + rank // 10)  # saturated colours first
        for rank, i in enumerate(sorted(largest))
    }
    figure = Figure(figsize=(11.0, 5.8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    before = cast("Axes3D", figure.add_subplot(1, 2, 1, projection="3d"))
    after = cast("Axes3D", figure.add_subplot(1, 2, 2, projection="3d"))
    for i, cluster in enumerate(clusters):
        colour = named.get(i, _OTHERS)
        _draw_points(before, cluster.before[cluster.inliers], colour, 1.0)
        _draw_points(before, cluster.before[~cluster.inliers], BLACK, 2.0)
        _draw_points(after, cluster.after, colour, 2.0)
    points = sum(len(cluster.before) for cluster in clusters)
    rejected = sum(int((~cluster.inliers).sum()) for cluster in clusters)
    before.set_title(f"before outlier rejection: {points} points, {rejected} rejected")
    after.set_title(f"after outlier rejection: {sum(len(cluster.after) for cluster in clusters)} voxels")
    _set_views([before, after], torch.cat([cluster.before for cluster in clusters]))
    figure.suptitle(title)
    entries = [*((clusters[i].label, colour) for i, colour in named.items()), ("rejected", BLACK)]
    if others := len(clusters) - len(named):
        entries.append((f"and {others} more", _OTHERS))
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
        axes.set(xlabel="x [m]", ylabel="z (depth) [m]", zlabel="-y [m]")
        axes.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), zlim=(-high[1], -low[1]))
        axes.set_aspect("equal", adjustable="box")
        axes.set_box_aspect(None, zoom=1.05)
        axes.view_init(elev=18, azim=-75)
        axes.locator_params(nbins=5)
