"""Occlusion boundaries between surfaces, at shadows and borders."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.calibration.view_edges import ViewEdges, find_edges

GREY = torch.full((3, 60, 80), 128, dtype=torch.uint8)


def edges_of(depth: Tensor, colour: Tensor = GREY, stride: int = 2) -> ViewEdges:
    return find_edges(colour, depth, stride)


def box_in_front(shadow: int = 0) -> Tensor:
    """A box at 1 m, rows 20 to 39 and columns 30 to 49, before a wall at 2 m, with a shadow to its left."""
    depth = torch.full((60, 80), 2.0)
    depth[20:40, 30 - shadow : 30] = 0.0
    depth[20:40, 30:50] = 1.0
    return depth


def test_boundaries_lie_between_the_surface_in_front_and_the_one_behind() -> None:
    edges = edges_of(box_in_front())
    sides = edges.pixel[edges.axis == 0]
    assert sorted(set(sides[:, 0].tolist())) == [29.5, 49.5]
    assert sorted(set(sides[:, 1].tolist())) == list(range(20, 40))
    ends = edges.pixel[edges.axis == 1]
    assert sorted(set(ends[:, 1].tolist())) == [19.5, 39.5]
    assert sorted(set(ends[:, 0].tolist())) == list(range(30, 50))
    assert (edges.depth == 1.0).all()


def test_a_shadow_belongs_to_the_surface_behind_and_a_wide_gap_to_neither() -> None:
    for shadow, expected in ((5, [29.5, 49.5]), (20, [49.5])):
        edges = edges_of(box_in_front(shadow))
        assert sorted(set(edges.pixel[edges.axis == 0][:, 0].tolist())) == expected


def test_slanted_surfaces_and_missing_depth_have_no_boundaries() -> None:
    slanted = torch.linspace(1, 3, 80).expand(60, 80).contiguous()
    for depth in (slanted, torch.zeros(60, 80)):
        assert len(edges_of(depth).axis) == 0


def test_gradients_follow_the_edges_of_the_image_and_have_no_mean() -> None:
    colour = GREY.clone()
    colour[:, :, 30:] = 200
    gradients = edges_of(box_in_front(), colour).gradients
    assert gradients.mean(dim=(1, 2)).abs().max() < 1e-5
    assert (gradients[0].argmax(dim=1) - 29.5).abs().max() <= 0.5
    assert gradients[1].abs().max() < 1e-5


def test_gap_of_a_shadow_can_be_wider_in_frames_with_more_columns() -> None:
    depth = torch.full((20, 640), 2.0)
    depth[:, 300:318], depth[:, 318:] = 0.0, 1.0  # 36 of 1280 columns, as 18 of 640
    assert set(edges_of(depth, torch.full((3, 20, 640), 128, dtype=torch.uint8)).pixel[:, 0].tolist()) == {317.5}


def test_views_of_a_few_pixels_have_gradients() -> None:
    """A stride of 90 leaves such views of 640x480 pixels."""
    depth, colour = torch.full((6, 8), 2.0), torch.full((3, 6, 8), 128, dtype=torch.uint8)
    assert edges_of(depth, colour, stride=90).gradients.isfinite().all()
