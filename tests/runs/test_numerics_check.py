"""Debug mode: the stage that gives NaN is named, what may be NaN is let through, and results stay as they are."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from v3d_torch import V3DSLAM, RGBDFrame, load_sequence
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import NumericsError
from v3d_torch.objects.frame_objects import MotionState, TrackedObject
from v3d_torch.objects.newly_occupied import NewlyOccupied
from v3d_torch.runs.numerics_check import STAGES, CheckedSLAM, CheckedStage, check_finite
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.run import Run
from v3d_torch.runs.state import OF_SLAM, gather, put_back, refresh
from v3d_torch.segmentation.mask_files import MaskFolder
from v3d_torch.types import Instances, TrackingStatus

NO_NETWORK = load_config(None, ("segmentation.source=none",))


class Pair(NamedTuple):
    near: Tensor
    far: float


@dataclass(frozen=True)
class Late(NewlyOccupied):
    seconds: float = 0.0


@pytest.fixture(scope="module")
def demo() -> RGBDSequence:
    return load_sequence("demo")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("value", "where"),
    [
        (lambda x: torch.tensor([[0.0, x], [1.0, 2.0]]), r"x is \w+: 1 of 4 numbers, the first at \[0, 1\]"),
        (lambda x: torch.tensor(x, dtype=torch.float16), r"x is \w+: 1 of 1 numbers$"),
        (lambda x: torch.tensor([complex(1.0, x)]), r"x is \w+"),
        (lambda x: np.array([x], np.float32), r"x is \w+"),
        (lambda x: np.float64(x), r"x is \w+"),
        (lambda x: x, r"x is \w+"),
        (lambda x: (1, None, "inf", [0.0, x]), r"x\[3\]\[1\] is"),
        (lambda x: {"here": torch.zeros(2), "there": torch.tensor(x)}, r"x\['there'\] is"),
        (lambda x: Pair(torch.zeros(3), x), r"x\.far is"),
        (lambda x: Late(torch.zeros(1), 4, x), r"x\.seconds is"),
        (lambda x: RGBDFrame(0, x, torch.zeros(3, 1, 1, dtype=torch.uint8), torch.zeros(1, 1, 1)), r"x\.stamp is"),
    ],
)
def test_what_is_not_finite_is_found_wherever_it_is(value: Callable[[float], Any], where: str, bad: float) -> None:
    check_finite("x", value(1.0))
    with pytest.raises(NumericsError, match=where) as caught:
        check_finite("x", value(bad))
    assert ("NaN" if math.isnan(bad) else "infinite") in str(caught.value)


def test_nan_that_means_something_is_let_through_and_infinity_is_not() -> None:
    check_finite("x", [NewlyOccupied(torch.tensor([math.nan, 1.0]), 4), Late(torch.tensor([math.nan]), 4)])
    with pytest.raises(NumericsError, match=r"x\.came is infinite: 1 of 2"):
        check_finite("x", NewlyOccupied(torch.tensor([math.nan, math.inf]), 4))


def test_whole_numbers_and_strange_things_are_passed_over() -> None:
    check_finite(
        "x", [torch.tensor([1, 2]), torch.tensor([True]), 3, "nan", b"nan", None, object(), float, NewlyOccupied]
    )


def test_every_stage_has_a_door(demo: RGBDSequence) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    plain = V3DSLAM(demo.camera, config=NO_NETWORK)
    callables = {name for name, value in vars(plain).items() if callable(value) and not name.startswith("_")}
    assert callables - {"clock"} == STAGES - {"loops", "back_end"}  # these are asked by their methods
    assert all(isinstance(getattr(slam, name), CheckedStage) for name in STAGES)


def spoilt(tensor: Tensor) -> Tensor:
    """The same with one number that is none."""
    return tensor.clone().index_fill_(0, torch.tensor([0]), math.nan)


NOWHERE = TrackedObject(
    id=0,
    label=0,
    mask=torch.zeros(480, 640, dtype=torch.bool),
    centroid=torch.full((3,), math.nan, dtype=torch.float64),
    votes=0,
    chamfer=math.nan,
    motion_state=MotionState.UNKNOWN,
    missed=False,
    cloud=torch.full((4, 3), math.nan),
)
"""All but its cloud may be NaN."""


def test_behind_its_door_a_stage_is_reached_and_changed(demo: RGBDSequence) -> None:
    first, second = islice(demo, 2)
    slam, other = (CheckedSLAM(demo.camera, config=NO_NETWORK) for _ in range(2))
    slam(first)
    put_back(other, gather(slam, OF_SLAM))
    refresh(other)
    assert len(other.mapper.map.keyframes) == 1
    assert other(second).status is TrackingStatus.TRACKED


@pytest.mark.parametrize(
    ("stage", "spoil", "named"),
    [
        ("smooth", spoilt, "smooth"),
        ("detect", lambda given: replace(given, uv=spoilt(given.uv)), "detect.uv"),
        ("lift", lambda given: replace(given, points=torch.full((1, 1, 3), math.nan)), "lift.points"),
        ("move", lambda given: replace(given, T_ba=spoilt(given.T_ba)), "move.T_ba"),
        ("judge", lambda given: replace(given, objects=[NOWHERE]), "judge.objects[0].cloud"),
        ("localise", lambda given: replace(given, T_cw=spoilt(given.T_cw)), "localise.T_cw"),
    ],
)
def test_a_stage_put_in_the_place_of_one_is_named_with_field_and_frame(
    demo: RGBDSequence, stage: str, spoil: Callable[[Any], Any], named: str
) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    for index in range(3):
        slam(demo[index])
    before, replaced = slam.poses.T_cw, getattr(slam, stage)
    setattr(slam, stage, lambda *args, **kwargs: spoil(replaced(*args, **kwargs)))
    with pytest.raises(NumericsError, match=rf"^frame 3: {re.escape(named)} is NaN"):
        slam(demo[3])
    assert torch.equal(slam.poses.T_cw, before)


def test_instances_that_are_not_finite_are_the_segmentations(demo: RGBDSequence) -> None:
    def segment(frame: RGBDFrame) -> Instances:
        return replace(Instances.empty(480, 640), boxes=torch.full((1, 4), math.inf))

    with pytest.raises(NumericsError, match=r"^frame 0: segment\.boxes is infinite: 4 of 4"):
        CheckedSLAM(demo.camera, segment, NO_NETWORK)(demo[0])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda frame: replace(frame, depth=frame.depth.clone().fill_(math.nan)), "depth is NaN"),
        (lambda frame: replace(frame, depth=frame.depth.clone().fill_(math.inf)), "depth is infinite"),
        (lambda frame: replace(frame, stamp=math.nan), "stamp is NaN"),
    ],
)
def test_a_frame_that_is_not_finite_is_refused(
    demo: RGBDSequence, change: Callable[[RGBDFrame], RGBDFrame], named: str
) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    slam(demo[0])
    with pytest.raises(NumericsError, match=rf"^frame 1: the input\.{named}"):
        slam(change(demo[1]))


def test_a_map_that_breaks_inside_is_noticed(demo: RGBDSequence) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    slam(demo[0])
    landmarks = slam.mapper.map.landmarks
    unseen = torch.zeros(1, 3, dtype=torch.float64)
    rows = {name: column[:1].clone() for name, column in landmarks.columns.items()}
    landmarks.append(**{**rows, "point": unseen / unseen})
    with pytest.raises(NumericsError, match=r"^frame 1: .*NaN"):
        slam(demo[1])


def poses(system: type[V3DSLAM], sequence: RGBDSequence, masks: Path, frames: int) -> bytes:
    slam = system(sequence.camera, MaskFolder(masks), load_config(None, ("segmentation.source=masks",)))
    lines = []
    for frame in islice(iter(sequence), frames):
        tracked = slam(frame)
        judged = [(each.id, each.votes, each.motion_state, each.centroid.tolist()) for each in tracked.objects]
        lines.append(repr((tracked.T_wc.tolist(), tracked.status, judged, int(tracked.static_mask.sum()))))
    T_wc = slam.poses.trajectory().T_wc
    return "\n".join(lines).encode() + T_wc.numpy().tobytes()


def test_the_demo_with_people_runs_clean_and_the_same(moment: Path) -> None:
    sequence = load_sequence(str(moment))
    plain, checked = (poses(system, sequence, moment / "masks", 6) for system in (V3DSLAM, CheckedSLAM))
    assert b"Verdict" in plain
    assert plain == checked


@pytest.mark.parametrize("name", ["walkers_room", "crowd_rpy"])
def test_real_images_run_clean_and_the_same(v3d_data: Path, name: str) -> None:
    sequence = load_sequence(name, data_root=v3d_data)
    plain, checked = (poses(system, sequence, v3d_data / name / "masks", 8) for system in (V3DSLAM, CheckedSLAM))
    assert plain == checked


def test_a_run_that_is_told_to_check_ends_there_and_keeps_what_was_computed(demo: RGBDSequence, tmp_path: Path) -> None:
    def segment(frame: RGBDFrame) -> Instances:
        return replace(Instances.empty(480, 640), boxes=torch.full((frame.index // 2, 4), math.nan))

    config = load_config(None, ("segmentation.source=none", "check_numerics=true"))
    run = Run(RunRequest("demo", config), demo, segment, tmp_path)
    run(lambda *_: None)
    assert run.pipeline.record.failure == "frame 2: segment.boxes is NaN: 4 of 4 numbers, the first at [0, 0]"
    assert len(read_trajectory(tmp_path / "trajectory.txt")) == 2
