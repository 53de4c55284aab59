"""Figure of the votes between objects, drawn on the image (the paper's figure of the voting mechanism)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from torch import Tensor

from v3d_torch.viz.figure_output import save_figure
from v3d_torch.viz.label_placement import draw_legend_and_separate_labels
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS, Overlay, draw_objects, parse_motion_state

VOTE_COLOUR = "#ff1f1f"
"""Colour of the lines between objects that voted for each other, red as in the paper."""

IdPair = tuple[int, int]
"""Ids of two objects, the smaller first."""


def save_voting_figure(
    image: Tensor,
    objects: Mapping[int, Overlay],
    centres: Mapping[int, Tensor],
    vote_pairs: Sequence[tuple[int, int]],
    path: Path,
    title: str = "",
) -> None:
    """Write a figure of the votes between objects to a file, see `draw_voting`.

    Args:
        image: Image, uint8 RGB, shape :math:`(3, H, W)`.
        objects: Mask, label and motion state of each object, by id.
        centres: Projected centroid of each object, by id, pixels (u, v).
        vote_pairs: Ids of the voter and of the object voted for, for each vote.
        path: Image file; the suffix (.png, .pdf, .svg) selects the format.
        title: Title of the figure.

    Raises:
        OutputError: If the file cannot be written.
    """
    save_figure(draw_voting(image, objects, centres, vote_pairs, title), path)


def draw_voting(
    image: Tensor,
    objects: Mapping[int, Overlay],
    centres: Mapping[int, Tensor],
    vote_pairs: Sequence[tuple[int, int]],
    title: str = "",
) -> Figure:
    """Draw the votes between objects as lines between their centroids, which are coloured by motion state.

    Votes for dynamic objects are bold red lines. Votes for other objects have no effect and are thin lines.

    Args:
        image: Image, uint8 RGB, shape :math:`(3, H, W)`.
        objects: Mask (bool, shape :math:`(H, W)`), label and motion state of each object, by id.
        centres: Projected centroid of each object, by id, pixels (u, v), shape :math:`(2,)`. Votes of an object without
            a centroid are not drawn.
        vote_pairs: Ids of the voter and of the object voted for, for each vote. Mutual votes are one line.
        title: Title of the figure.
    """
    height, width = image.shape[1:]
    figure = Figure(figsize=(8.0, 8.0 * height / width + 0.6), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.axis("off")
    draw_objects(axes, image, list(objects.values()))
    with_position = [pair for pair in vote_pairs if centres.keys() >= set(pair)]
    dynamic = [id_ for id_, (_, _, motion_state) in objects.items() if motion_state == "dynamic"]
    effective, ineffective = split_votes(with_position, dynamic)
    for pairs, linewidth, rim, alpha in ((ineffective, 0.7, 0.7, 0.5), (effective, 2.0, 3.4, 1.0)):
        lines = [[tuple(centres[id_].tolist()) for id_ in pair] for pair in pairs]
        effects = [Stroke(linewidth=rim, foreground="white"), Normal()]
        style = {"colors": VOTE_COLOUR, "linewidths": linewidth, "alpha": alpha}
        axes.add_collection(LineCollection(lines, path_effects=effects, zorder=2.5, **style))
    for id_, centre in centres.items():
        colour = MOTION_STATE_COLOURS[parse_motion_state(objects[id_][2])]
        axes.plot(*centre.tolist(), "o", color=colour, markeredgecolor="white", markersize=8, zorder=2.7)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), title=title)
    handles = _legend_handles(objects, ineffective=bool(ineffective))
    draw_legend_and_separate_labels(figure, handles, 6)
    return figure


def split_votes(vote_pairs: Iterable[tuple[int, int]], dynamic: Collection[int]) -> tuple[list[IdPair], list[IdPair]]:
    """Split the pairs of objects with a vote by whether a vote was for a dynamic object.

    Args:
        vote_pairs: Ids of the voter and of the object voted for, for each vote.
        dynamic: Ids of the dynamic objects.

    Returns:
        Pairs with a vote for a dynamic object, and all other pairs, each pair once, both sorted.
    """
    vote_pairs = list(vote_pairs)
    effective = {(min(pair), max(pair)) for pair in vote_pairs if pair[1] in dynamic}
    return sorted(effective), sorted({(min(pair), max(pair)) for pair in vote_pairs} - effective)


def _legend_handles(objects: Mapping[int, Overlay], *, ineffective: bool) -> list[Line2D]:
    present = {parse_motion_state(motion_state) for _, _, motion_state in objects.values()}
    states = [(name, colour) for name, colour in MOTION_STATE_COLOURS.items() if name in present]
    thin_line = [Line2D([], [], color=VOTE_COLOUR, alpha=0.5, linewidth=0.7, label="vote without effect")]
    return [
        Line2D([], [], color=VOTE_COLOUR, linewidth=2.0, label="vote"),
        *(thin_line if ineffective else []),
        *(Line2D([], [], color=colour, label=name, marker="o", linestyle="none") for name, colour in states),
    ]
