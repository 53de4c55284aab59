"""The figure of outlier rejection: clouds of objects before and after it (the paper's figure of the same)."""

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

from v3d_torch.viz.figures import save

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

BLACK = (0.0, 0.0, 0.0, 1.0)
"""What is rejected."""

_MOST_POINTS = 3000  # drawn of each cloud, evenly chosen: more only hides what lies behind


@dataclass(frozen=True)
class Cluster:
    """The cloud of an object before and after outlier rejection, camera frame, metres.

    Attributes:
        text: such as "person 3".
        before: points of all pixels of the mask, shape :math:`(N, 3)`.
        kept: which of them are in the cluster that stayed, bool, shape :math:`(N,)`.
        after: that cluster's voxels, shape :math:`(M, 3)`.
    """

    text: str
    before: Tensor
    kept: Tensor
    after: Tensor


def clusters_figure(clusters: Sequence[Cluster], path: Path, title: str = "") -> None:
    """Draw clouds before and after outlier rejection to a file, see `draw_clusters`.

    Args:
        clusters: at least one.
        path: image to write; the suffix (.png, .pdf, .svg) chooses the format.
        title: printed above.

    Raises:
        OutputError: when the file cannot be written.
        ValueError: there is no cluster.
    """
    save(draw_clusters(clusters, title), path)


def draw_clusters(clusters: Sequence[Cluster], title: str = "") -> Figure:
    """Draw clouds before outlier rejection, what it rejects in black, and after it, seen from above the camera.

    Args:
        clusters: at least one.
        title: printed above.

    Raises:
        ValueError: there is no cluster.
    """
    if not clusters:
        raise ValueError("a figure of clusters needs at least one")
    colours = [colormaps["tab20"](2 * i % 20 + i // 10 % 2) for i in range(len(clusters))]  # strong ones first
    figure = Figure(figsize=(11.0, 5.8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    before = cast("Axes3D", figure.add_subplot(1, 2, 1, projection="3d"))
    after = cast("Axes3D", figure.add_subplot(1, 2, 2, projection="3d"))
    for cluster, colour in zip(clusters, colours, strict=True):
        _scatter(before, cluster.before[cluster.kept], colour, 1.0)
        _scatter(before, cluster.before[~cluster.kept], BLACK, 2.0)
        _scatter(after, cluster.after, colour, 2.0)
    rejected = sum(int((~cluster.kept).sum()) for cluster in clusters)
    before.set_title(f"before: {sum(len(cluster.before) for cluster in clusters)} points, {rejected} rejected")
    after.set_title(f"after: {sum(len(cluster.after) for cluster in clusters)} voxels")
    _frame([before, after], torch.cat([cluster.before for cluster in clusters]))
    figure.suptitle(title)
    handles = [
        Line2D([], [], color=colour, label=text, marker="o", linestyle="none", markersize=5)
        for text, colour in zip([*(cluster.text for cluster in clusters), "rejected"], [*colours, BLACK], strict=True)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    return figure


def _scatter(axes: Axes3D, points: Tensor, colour: tuple[float, float, float, float], size: float) -> None:
    x, y, z = points[:: max(1, -(-len(points) // _MOST_POINTS))].T.numpy()
    axes.scatter(x, z, -y, s=size, color=[colour], linewidths=0, depthshade=False)  # up is up


def _frame(both: Sequence[Axes3D], points: Tensor) -> None:
    """The same view for both, equal scales, all points within."""
    low, high = (points.amin(dim=0) - 0.05).tolist(), (points.amax(dim=0) + 0.05).tolist()
    for axes in both:
        axes.set(xlabel="x [m]", ylabel="z, depth [m]", zlabel="-y, up [m]")
        axes.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), zlim=(-high[1], -low[1]))
        axes.set_aspect("equal", adjustable="box")
        axes.set_box_aspect(None, zoom=1.05)
        axes.view_init(elev=18, azim=-75)
        axes.locator_params(nbins=5)
