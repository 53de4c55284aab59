"""The figure of a vote: who voted for whom, on the image (the paper's figure of the voting mechanism)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from torch import Tensor

from v3d_torch.viz.ballots import lines_of
from v3d_torch.viz.figures import MOTION_STATE_COLOURS, Overlay, draw_objects, parse_motion_state, save

VOTE_COLOUR = "#ff1f1f"
"""Of the lines between objects that voted, red in the paper."""


def voting_figure(
    image: Tensor,
    objects: Mapping[int, Overlay],
    centres: Mapping[int, Tensor],
    ballots: Sequence[tuple[int, int]],
    path: Path,
    title: str = "",
) -> None:
    """Draw who voted for whom to a file, see `draw_voting`.

    Args:
        image: uint8 RGB, shape :math:`(3, H, W)`.
        objects: by id: mask, text, verdict.
        centres: by id: the centroid's pixel.
        ballots: ids of who voted and for whom.
        path: image to write; the suffix (.png, .pdf, .svg) chooses the format.
        title: printed above.

    Raises:
        OutputError: when the file cannot be written.
    """
    save(draw_voting(image, objects, centres, ballots, title), path)


def draw_voting(
    image: Tensor,
    objects: Mapping[int, Overlay],
    centres: Mapping[int, Tensor],
    ballots: Sequence[tuple[int, int]],
    title: str = "",
) -> Figure:
    """Draw who voted for whom: lines between centroids, which are coloured by verdict.

    Votes for what is dynamic are bold, red lines; votes for others, which came to nothing, are thin.

    Args:
        image: uint8 RGB, shape :math:`(3, H, W)`.
        objects: by id: mask (bool, shape :math:`(H, W)`), text, verdict (`MOTION_STATE_COLOURS`).
        centres: by id: the centroid's pixel, (u, v), shape :math:`(2,)`; an object without one has no lines.
        ballots: ids of who voted and for whom; a vote that both gave each other is one line.
        title: printed above.
    """
    height, width = image.shape[1:]
    figure = Figure(figsize=(8.0, 8.0 * height / width + 0.6), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.axis("off")
    draw_objects(axes, image, list(objects.values()))
    drawn = [ballot for ballot in ballots if centres.keys() >= set(ballot)]
    bold, thin = lines_of(drawn, [number for number, (_, _, verdict) in objects.items() if verdict == "dynamic"])
    for pairs, linewidth, rim, alpha in ((thin, 0.7, 0.7, 0.5), (bold, 2.0, 3.4, 1.0)):
        lines = [[tuple(centres[one].tolist()) for one in pair] for pair in pairs]
        effects = [Stroke(linewidth=rim, foreground="white"), Normal()]
        style = {"colors": VOTE_COLOUR, "linewidths": linewidth, "alpha": alpha}
        axes.add_collection(LineCollection(lines, path_effects=effects, zorder=2.5, **style))
    for number, centre in centres.items():
        colour = MOTION_STATE_COLOURS[parse_motion_state(objects[number][2])]
        axes.plot(*centre.tolist(), "o", color=colour, markeredgecolor="white", markersize=8, zorder=2.7)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), title=title)
    figure.legend(handles=_legend(objects, some_thin=bool(thin)), loc="outside lower center", ncols=6, frameon=False)
    return figure


def _legend(objects: Mapping[int, Overlay], *, some_thin: bool) -> list[Line2D]:
    present = {parse_motion_state(verdict) for _, _, verdict in objects.values()}
    shown = [(verdict, colour) for verdict, colour in MOTION_STATE_COLOURS.items() if verdict in present]
    without_effect = [Line2D([], [], color=VOTE_COLOUR, alpha=0.5, linewidth=0.7, label="without effect")]
    return [
        Line2D([], [], color=VOTE_COLOUR, linewidth=2.0, label="vote: a distance that changed"),
        *(without_effect if some_thin else []),
        *(Line2D([], [], color=colour, label=verdict, marker="o", linestyle="none") for verdict, colour in shown),
    ]
