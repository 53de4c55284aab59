"""Placement of labels in a figure, and the legend that counts those left out."""

from __future__ import annotations

import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from v3d_torch.viz.label_placement import draw_legend_and_separate_labels, separate_labels


@pytest.fixture
def axes() -> Axes:
    """Axes from 0 to 1 in a figure that is high enough for some labels."""
    return Figure(figsize=(4, 2)).add_subplot()


def patch_box(text: Text) -> Bbox:
    """Box of the background of a label in the figure."""
    patch = text.get_bbox_patch()
    assert patch is not None
    return patch.get_window_extent()


def test_label_without_a_place_is_hidden() -> None:
    figure = Figure(figsize=(2, 1))
    axes = figure.add_subplot()
    for number in range(30):
        axes.annotate(f"name {number}", (0.5, 0.5))
    separate_labels(figure)
    shown = [text for text in axes.texts if text.get_visible()]
    assert 1 <= len(shown) < 10


def test_upper_label_keeps_its_place_and_the_lower_one_makes_way(axes: Axes) -> None:
    lower, upper = (axes.text(0.5, y, "person 1") for y in (0.6, 0.62))
    assert separate_labels(axes.figure) == 0
    assert upper.get_position() == pytest.approx((0.5, 0.62))
    assert lower.get_position()[0] == pytest.approx(0.5)
    assert lower.get_window_extent().y1 <= upper.get_window_extent().y0


@pytest.mark.parametrize("x", [0.2, 0.99])
@pytest.mark.parametrize("y", [-0.5, -0.3, -0.1, -0.02])
def test_label_beyond_an_edge_is_moved_into_the_axes(axes: Axes, x: float, y: float) -> None:
    """Also if the distance to the edge is rounded: no label is hidden that has a place."""
    label = axes.text(x, y, "person 1")
    assert separate_labels(axes.figure) == 0
    box, inside = label.get_window_extent(), axes.bbox
    assert box.y0 == pytest.approx(inside.y0) and inside.x0 < box.x0 and box.x1 <= inside.x1 + 1e-6
    assert (abs(label.get_position()[0] - x) < 1e-6) == (x == 0.2)  # only the other label reaches the right edge


def test_backgrounds_of_labels_do_not_cover_each_other(axes: Axes) -> None:
    labels = [axes.text(0.3, y, "person 1", bbox={"pad": 12}) for y in (0.45, 0.65)]
    axes.figure.draw_without_rendering()
    texts, backgrounds = ([box(label) for label in labels] for box in (Text.get_window_extent, patch_box))
    assert not texts[0].overlaps(texts[1]) and backgrounds[0].overlaps(backgrounds[1])
    assert separate_labels(axes.figure) == 0
    axes.figure.draw_without_rendering()  # moves the backgrounds to the labels
    assert not patch_box(labels[0]).overlaps(patch_box(labels[1]).shrunk(0.99, 0.99))


def test_text_without_letters_is_no_label(axes: Axes) -> None:
    empty = axes.text(2.0, 0.5, "")
    assert separate_labels(axes.figure) == 0
    assert empty.get_position() == (2.0, 0.5)


@pytest.mark.parametrize(("number", "note"), [(0, []), (1, ["1 name left out"]), (2, ["2 names left out"])])
def test_legend_counts_the_labels_that_are_left_out(axes: Axes, number: int, note: list[str]) -> None:
    for _ in range(number + 1):
        axes.text(0.5, 0.0, "person 1")  # there is a place for one of them
    draw_legend_and_separate_labels(axes.figure, [Patch(label="dynamic")], 2)
    (legend,) = axes.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["dynamic", *note]
