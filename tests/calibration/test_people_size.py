"""Apparent size of people: exact for upright and rolled people, and the warnings that follow from it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from v3d_torch.calibration.people_size import apparent_sizes, check_people_size
from v3d_torch.calibration.plausibility import check_plausibility
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.objects.frame_objects import MotionState, TrackedObject
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.segmentation.coco import PERSON
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(fx=50.0, fy=40.0, cx=39.5, cy=29.5, width=80, height=60, depth_scale=5000.0)
POSITION = torch.zeros(3, dtype=torch.float64)


def person(rows: slice, columns: slice, *, label: int = PERSON, missed: bool = False) -> TrackedObject:
    mask = torch.zeros(60, 80, dtype=torch.bool)
    mask[rows, columns] = True
    state = ObjectState(0.0, POSITION, POSITION, (0.01, 0.0, 0.1), 2.0)
    return TrackedObject(1, label, mask, state, (), 0, torch.nan, MotionState.STATIC, missed, torch.zeros(0, 3))


def depth_of(metres: float) -> torch.Tensor:
    depth = torch.full((1, 60, 80), metres)
    depth[0, ::2] = 0  # half of the pixels have no measurement
    return depth


def test_size_is_that_of_the_longer_side() -> None:
    upright, lying = person(slice(10, 30), slice(5, 12)), person(slice(10, 17), slice(5, 30))
    assert apparent_sizes([upright], depth_of(3.0), CAMERA) == pytest.approx([20 * 3.0 / 40])
    assert apparent_sizes([lying], depth_of(3.0), CAMERA) == pytest.approx([25 * 3.0 / 50])


def test_only_detected_people_with_depth_are_measured() -> None:
    area = slice(10, 30), slice(5, 12)
    objects = [person(*area, label=PERSON + 1), person(*area, missed=True), person(slice(10, 11), slice(5, 9))]
    assert apparent_sizes(objects, depth_of(3.0), CAMERA) == []
    assert apparent_sizes([person(*area)], torch.zeros(1, 60, 80), CAMERA) == []


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ([0.5] * 10 + [1.7] * 10, None),
        ([0.2] * 17 + [0.9] * 3, None),  # mostly covered people
        ([2.5] * 10 + [5.0] * 5, None),  # groups with one mask
        ([0.1] * 14, None),  # too few
        (
            [0.1] * 10 + [0.35] * 10,
            "nearly all people seem to be smaller than 0.35 m; the depth_scale 5000 seems",
        ),
        ([0.2] * 18 + [0.9], "nearly all people seem to be smaller than "),
        ([1.0] * 7 + [8.0] * 10, "half of the people seem to be larger than 8 m; the depth_scale 5000 seems to"),
    ],
)
def test_warning_about_sizes_that_people_do_not_have(sizes: list[float], words: str | None) -> None:
    warnings = check_people_size(sizes, CAMERA)
    assert [warning.startswith(words or "") for warning in warnings] == ([] if words is None else [True])
    assert check_people_size(sizes, replace(CAMERA, depth_scale=None)) == []


def test_sizes_are_part_of_the_plausibility_check() -> None:
    trajectory = Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
    checked = [
        check_plausibility(MapTables(), StaticViews(CAMERA, 2), [size] * 20, trajectory, CAMERA, Config())
        for size in (0.2, 1.7)
    ]
    assert [len(warnings) for warnings in checked] == [1, 0]
