"""Markers of objects: boxes, names, velocities, and removal of the markers of the frame before."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from matplotlib.colors import to_rgb
from torch import Tensor

from v3d_torch.export.ros.frames import map_frame
from v3d_torch.export.ros.markers import Marker, object_markers
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS

MASK = torch.zeros(2, 2, dtype=torch.bool)
CLOUD = torch.cartesian_prod(torch.tensor([1.0, 2.0]), torch.tensor([-0.5, 1.5]), torch.tensor([4.0, 4.5]))
"""Points right of the camera, 2 m high: x from 1 to 2, y (down) from -0.5 to 1.5, z from 4 to 4.5."""


UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
AT_REST = torch.zeros(3, dtype=torch.float64)


def make_object(
    state: MotionState,
    cloud: Tensor = CLOUD,
    centroid: Tensor | None = None,
    velocity: Tensor = AT_REST,
    **other: Any,
) -> Any:
    centroid = cloud.mean(dim=0).to(torch.float64) if centroid is None else centroid
    motion = ObjectState(2.5, centroid, velocity, (0.01, 0.0, 0.04), 2.0)
    values = {"id": 7, "label": 0, "mask": MASK, "votes": 0, "chamfer": 0.0, "missed": False, **other}
    return TrackedObject(motion_state=state, cloud=cloud, state=motion, history=(), **values)


def markers_of(*objects: TrackedObject) -> dict[str, Any]:
    shown = FrameObjects(list(objects), ~MASK, ~MASK, [])
    first, *others = object_markers(2.5, shown, UP, map_frame(None)).markers
    assert first.action == Marker.DELETEALL
    assert all(each.action == Marker.ADD and each.header.frame_id == "map" for each in others)
    return {each.ns: each for each in others}


def components(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def test_convention_box_encloses_the_cloud_in_map() -> None:
    box = markers_of(make_object(MotionState.STATIC))["boxes"]
    assert (box.type, box.id) == (Marker.CUBE, 7)
    assert components(box.pose.position) == pytest.approx([4.25, -1.5, -0.5])  # forward, left, up
    assert components(box.scale) == pytest.approx([1.0, 0.5, 2.0])  # at rest, forward is the longer side: to the left
    assert abs(box.pose.orientation.z) == pytest.approx(0.5**0.5) and abs(box.pose.orientation.w) == pytest.approx(
        0.5**0.5
    )


def test_box_of_missed_object_encloses_its_cloud_which_moves_with_the_prediction() -> None:
    predicted = CLOUD + torch.tensor([1.0, 0.0, 0.0])
    box = markers_of(make_object(MotionState.DYNAMIC, predicted, missed=True))["boxes"]
    assert components(box.pose.position) == pytest.approx([4.25, -2.5, -0.5])


def test_name_is_above_the_box_in_the_colour_of_the_motion_state() -> None:
    markers = markers_of(make_object(MotionState.DYNAMIC))
    name, box = markers["names"], markers["boxes"]
    assert (name.type, name.text) == (Marker.TEXT_VIEW_FACING, "person 7, dynamic")
    assert name.pose.position.z > box.pose.position.z + box.scale.z / 2
    assert (name.color.r, name.color.g, name.color.b) == pytest.approx(to_rgb(MOTION_STATE_COLOURS["dynamic"]))
    assert (name.color.a, box.color.a) == (1.0, pytest.approx(0.4))


def test_velocity_of_dynamic_object_is_an_arrow_to_its_place_a_second_later() -> None:
    velocity = torch.tensor([-1.0, 0.0, 0.5], dtype=torch.float64)  # to the left and away
    markers = markers_of(make_object(MotionState.DYNAMIC, velocity=velocity))
    start, end = markers["velocities"].points
    assert components(start) == pytest.approx([4.25, -1.5, -0.5])
    assert [b - a for a, b in zip(components(start), components(end), strict=True)] == pytest.approx([0.5, 1.0, 0.0])
    assert "velocities" not in markers_of(make_object(MotionState.STATIC, velocity=velocity))


def test_objects_without_centroid_or_cloud_have_no_markers() -> None:
    nowhere = make_object(MotionState.UNKNOWN, centroid=torch.full((3,), torch.nan, dtype=torch.float64))
    empty = make_object(MotionState.UNKNOWN, cloud=torch.zeros(0, 3), centroid=torch.zeros(3, dtype=torch.float64))
    assert markers_of(nowhere, empty) == {}


def test_flat_object_has_a_box_with_volume() -> None:
    box = markers_of(make_object(MotionState.STATIC, cloud=CLOUD[:1]))["boxes"]
    assert min(components(box.scale)) > 0
