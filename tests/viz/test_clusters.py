"""Figure of outlier rejection: rejected points in black, counts, legend."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from helpers.figure_pixels import count_pixels, read_picture
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from v3d_torch.viz.clusters import Cluster, draw_clusters, save_clusters_figure

BLACK, BLUE = "black", "tab:blue"


def make_cluster(rejected: int, label: str = "person 3") -> Cluster:
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(2))
    return Cluster(label, points, torch.arange(200) >= rejected, points[rejected::4])


def legend_entries(figure: Figure) -> list[tuple[Text, Line2D]]:
    (legend,) = figure.legends
    return list(zip(legend.get_texts(), legend.get_lines(), strict=True))


def test_rejected_points_are_black(tmp_path: Path) -> None:
    save_clusters_figure([make_cluster(0)], tmp_path / "none.png")
    save_clusters_figure([make_cluster(150)], tmp_path / "many.png")
    none, many = read_picture(tmp_path / "none.png"), read_picture(tmp_path / "many.png")
    half = none.shape[1] // 2
    assert count_pixels(many[150:600, :half], BLACK) > count_pixels(none[150:600, :half], BLACK) + 100
    assert count_pixels(none[:, :half], BLUE) > 150 > count_pixels(many[:, :half], BLUE)
    save_clusters_figure([make_cluster(150), make_cluster(10, "chair 4")], tmp_path / "both.svg")
    words = re.findall(r"<!-- (.+?) -->", (tmp_path / "both.svg").read_text())
    assert {
        "before outlier rejection: 400 points, 160 rejected",
        "after outlier rejection: 61 voxels",
        "person 3",
        "chair 4",
        "rejected",
    } <= set(words)
    with pytest.raises(ValueError, match="at least one"):
        save_clusters_figure([], tmp_path / "empty.png")


def test_only_the_largest_of_many_clusters_have_a_name_and_a_colour() -> None:
    clusters = [make_cluster(0, f"chair {number}") for number in range(23)]
    for number in (0, 5, 22):
        small = clusters[number]
        clusters[number] = Cluster(small.label, small.before[:150], small.inliers[:150], small.after)
    figure = draw_clusters(clusters)
    entries = {text.get_text(): handle for text, handle in legend_entries(figure)}
    named = [f"chair {number}" for number in range(23) if number not in (0, 5, 22)]
    assert list(entries) == [*named, "rejected", "and 3 more"]
    assert len({entry.get_color() for entry in entries.values()}) == len(entries)
    assert "more" not in " ".join(text.get_text() for text, _ in legend_entries(draw_clusters(clusters[1:21])))
