"""Evidence of free space: the smallest objects for which it counts."""

from __future__ import annotations

import pytest
import torch

from v3d_torch.config import FreeSpaceConfig, TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.packed_masks import pack_masks
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.motion_evidence import free_space_evidence
from v3d_torch.objects.track import Track
from v3d_torch.segmentation.coco import PERSON, UNLABELLED

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
STRIDE = 4


@pytest.mark.parametrize(("label", "fewest"), [(PERSON, FreeSpaceConfig().min_points), (UNLABELLED, 9)])
def test_object_has_mostly_appeared_only_if_enough_of_its_pixels_are_known(label: int, fewest: int) -> None:
    """A region without a class consists of new pixels, so that fewer of them are enough."""
    view = DepthView(0.0, torch.full((1, 120, 160), 3.0), torch.eye(4, dtype=torch.float64))
    appeared = AppearedPixels(torch.ones(1, 30, 40, dtype=torch.float64), STRIDE)
    for count in (fewest - 1, fewest):
        mask = torch.zeros(120, 160, dtype=torch.bool)
        mask[:STRIDE, : STRIDE * count] = True
        track = Track(1, 0.0, TrackerConfig(), mask, mask, *(pack_masks(mask, STRIDE),) * 2)
        track.update_label(label, 0.0)
        evidence = free_space_evidence([track], {}, view, appeared, FreeSpaceConfig(), CAMERA)
        assert evidence.has_mostly_appeared(track) is (count == fewest)
