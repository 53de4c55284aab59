"""Figure of the objects from above: paths, boxes and names, and an arrow for what moves."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.text import Annotation

from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.pipeline.run_record import ObjectTable
from v3d_torch.types import RGBDFrame, Trajectory
from v3d_torch.viz.objects_figure import box_outline, draw_objects_from_above

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
MASK = torch.zeros(2, 2, dtype=torch.bool)
CUBE = torch.cartesian_prod(*[torch.tensor([-0.25, 0.25])] * 3)


def object_at(stamp: float, number: int, x: float, state: MotionState) -> TrackedObject:
    position = torch.tensor([x, 0.0, 3.0], dtype=torch.float64)
    velocity = torch.tensor([1.0 if state is MotionState.DYNAMIC else 0.0, 0.0, 0.0], dtype=torch.float64)
    motion = ObjectState(stamp, position, velocity, (0.01, 0.0, 0.1), 2.0)
    return TrackedObject(number, 0, MASK, motion, (), 0, torch.nan, state, False, CUBE + position.float())


def table_of(
    *objects: tuple[int, MotionState], frames: int = 8, spacing: float = 1.0, measured: int | None = None
) -> ObjectTable:
    """Return a table in which each object stands at its number times a spacing, or moves to the right with 1 m/s.

    From the frame ``measured`` on, they have no points.
    """
    table, image = ObjectTable(), torch.zeros(3, 2, 2, dtype=torch.uint8)
    for index in range(frames):
        stamp = index / 10
        shown = [
            object_at(stamp, n, spacing * n + (stamp if state is MotionState.DYNAMIC else 0), state)
            for n, state in objects
        ]
        if measured is not None and index >= measured:
            shown = [replace(each, cloud=each.cloud[:0]) for each in shown]
        table.append_objects(
            RGBDFrame(index, stamp, image, torch.ones(1, 2, 2)), FrameObjects(shown, MASK, MASK, []), UP
        )
    return table


def draw_axes(table: ObjectTable) -> Axes:
    trajectory = Trajectory(torch.arange(2.0), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
    (axes,) = draw_objects_from_above(table, trajectory, torch.rand(5, 3), UP, "room $1").axes
    return axes


def draw(table: ObjectTable) -> list[str]:
    """Return the texts of the figure, with an empty one for each arrow."""
    axes = draw_axes(table)
    assert axes.get_title() == "room $1"
    return [text.get_text() for text in axes.texts]


def test_objects_have_names_and_dynamic_ones_an_arrow() -> None:
    table = table_of((1, MotionState.STATIC), (2, MotionState.DYNAMIC))
    assert draw(table) == ["person 1", "person 2", ""]


def test_arrow_ends_inside_of_the_axes() -> None:
    """Else it would not be drawn: nothing else is as far away as the object would be a second later."""
    axes = draw_axes(table_of((1, MotionState.DYNAMIC)))
    (arrow,) = [text for text in axes.texts if not text.get_text()]
    assert isinstance(arrow, Annotation)
    assert axes.bbox.contains(*axes.transData.transform(arrow.xy))


def test_names_of_objects_at_the_same_place_do_not_overlap() -> None:
    axes = draw_axes(table_of(*((number, MotionState.STATIC) for number in range(1, 6)), spacing=0.01))
    boxes = [text.get_window_extent() for text in axes.texts]
    assert len(boxes) == 5 and all(box.x1 <= axes.bbox.x1 + 1 for box in boxes)
    assert not any(a.overlaps(b.shrunk(0.99, 0.99)) for a, b in combinations(boxes, 2))


def test_objects_of_few_frames_are_not_drawn() -> None:
    table = table_of((1, MotionState.STATIC), frames=4)
    assert draw(table) == []
    assert draw_axes(table).get_xlabel() == "x [m]\nnot drawn: 1 that were measured in fewer than 5 frames"


def test_objects_without_a_name_are_counted() -> None:
    axes = draw_axes(table_of(*((number, MotionState.STATIC) for number in range(1, 60))))
    named = sum(text.get_visible() for text in axes.texts)
    assert named <= 50 and axes.get_xlabel() == f"x [m]\nwithout a name: {59 - named}"


def test_path_has_gap_where_the_object_was_not_seen() -> None:
    table, away = table_of((1, MotionState.DYNAMIC)), object_at(3.0, 1, 4.0, MotionState.DYNAMIC)
    for index in (30, 31):
        frame = RGBDFrame(index, index / 10, torch.zeros(3, 2, 2, dtype=torch.uint8), torch.ones(1, 2, 2))
        table.append_objects(frame, FrameObjects([away], MASK, MASK, []), UP)
    (path,) = [each for each in draw_axes(table).collections if isinstance(each, LineCollection)]
    assert len(path.get_segments()) == 8  # between ten places, without that from frame 7 to 30


def test_camera_path_has_gap_where_there_are_no_frames() -> None:
    stamps = torch.tensor([0.0, 1, 2, 100, 101], dtype=torch.float64)
    trajectory = Trajectory(stamps, torch.eye(4, dtype=torch.float64).repeat(5, 1, 1))
    (axes,) = draw_objects_from_above(table_of((1, MotionState.STATIC)), trajectory, torch.rand(5, 3), UP).axes
    assert torch.tensor(axes.lines[0].get_xdata()).isnan().nonzero()[:, 0].tolist() == [3]


def test_only_the_most_important_of_many_objects_have_a_name() -> None:
    """Those that moved, then those with the most frames."""
    table = table_of(*((number, MotionState.STATIC) for number in range(1, 200)), (200, MotionState.DYNAMIC))
    image = torch.zeros(3, 2, 2, dtype=torch.uint8)
    longest = FrameObjects([object_at(0.8, 150, 150, MotionState.STATIC)], MASK, MASK, [])
    table.append_objects(RGBDFrame(8, 0.8, image, torch.ones(1, 2, 2)), longest, UP)
    names = [text for text in draw(table) if text]
    assert names == [*(f"person {number}" for number in range(1, 49)), "person 150", "person 200"]


def test_outline_encloses_the_cube_from_above() -> None:
    """Level frame: x is forward (world z), y is left (minus world x)."""
    outline = box_outline(table_of((2, MotionState.STATIC))["box"][0], level_frame(UP)[:3, :3])
    assert outline.shape == (5, 2)
    torch.testing.assert_close(torch.from_numpy(outline.min(axis=0)), torch.tensor([2.75, -2.25]).double())
    torch.testing.assert_close(torch.from_numpy(outline.max(axis=0)), torch.tensor([3.25, -1.75]).double())


def test_object_that_was_measured_in_few_frames_is_not_drawn_but_counted() -> None:
    assert len(draw(table_of((1, MotionState.STATIC), measured=5))) == 1
    axes = draw_axes(table_of((1, MotionState.STATIC), measured=4))
    assert not axes.texts
    assert axes.get_xlabel() == "x [m]\nnot drawn: 1 that were measured in fewer than 5 frames"
