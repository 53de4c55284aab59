"""Point cloud message, read by the layout that it states."""

from __future__ import annotations

import torch
from helpers.bag_messages import points_of, stamp_of

from v3d_torch.export.ros.point_cloud import point_cloud


def test_points_and_colours_are_exact() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(50, 3, generator=generator)
    colours = torch.randint(0, 256, (50, 3), generator=generator, dtype=torch.uint8)
    cloud = point_cloud(2.5, "map", points, colours)
    assert (cloud.header.frame_id, stamp_of(cloud.header), cloud.is_dense) == ("map", 2.5, True)
    xyz, rgb = points_of(cloud)
    assert torch.equal(torch.from_numpy(xyz.copy()), points)
    assert torch.equal(torch.from_numpy(rgb.copy()), colours)


def test_empty_cloud_has_no_data() -> None:
    cloud = point_cloud(2.5, "map", torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    assert (cloud.width, cloud.height, len(cloud.data)) == (0, 1, 0)
