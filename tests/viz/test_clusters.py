"""Figure of outlier rejection: rejected points in black, counts, legend."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from helpers.pictures import count_pixels, read_picture

from v3d_torch.viz.clusters import Cluster, save_clusters_figure

BLACK, BLUE = "black", "tab:blue"


def make_cluster(rejected: int, label: str = "person 3") -> Cluster:
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(2))
    return Cluster(label, points, torch.arange(200) >= rejected, points[rejected::4])


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
