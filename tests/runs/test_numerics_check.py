"""Debug mode: the error names the stage that returns NaN, documented NaN is accepted, and results are unchanged."""

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
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.frame_objects import MotionState, TrackedObject
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.runs.numerics_check import CheckedSLAM, CheckedStage, check_finite
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.run import Run
from v3d_torch.segmentation.mask_files import MaskFolder
from v3d_torch.types import Instances, TrackingStatus

NO_NETWORK = load_config(None, ("segmentation.source=none",))


class Pair(NamedTuple):
    near: Tensor
    far: float


@dataclass(frozen=True)
class TimedPixels(AppearedPixels):
    seconds: float = 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("make_value", "message"),
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
        (lambda x: TimedPixels(torch.zeros(1), 4, x), r"x\.seconds is"),
        (lambda x: RGBDFrame(0, x, torch.zeros(3, 1, 1, dtype=torch.uint8), torch.zeros(1, 1, 1)), r"x\.stamp is"),
    ],
)
def test_non_finite_numbers_are_found_at_any_depth(
    make_value: Callable[[float], Any], message: str, bad: float
) -> None:
    check_finite("x", make_value(1.0))
    with pytest.raises(NumericsError, match=message) as caught:
        check_finite("x", make_value(bad))
    assert ("NaN" if math.isnan(bad) else "infinite") in str(caught.value)


def test_documented_nan_is_accepted_and_infinity_is_not() -> None:
    check_finite("x", [AppearedPixels(torch.tensor([math.nan, 1.0]), 4), TimedPixels(torch.tensor([math.nan]), 4)])
    with pytest.raises(NumericsError, match=r"x\.was_free is infinite: 1 of 2"):
        check_finite("x", AppearedPixels(torch.tensor([math.nan, math.inf]), 4))


def test_documented_infinity_is_accepted_and_nan_is_not() -> None:
    check_finite("x", {"readout": Readout(0.02, math.inf)})
    with pytest.raises(NumericsError, match=r"x\.information is NaN"):
        check_finite("x", Readout(0.02, math.nan))
    with pytest.raises(NumericsError, match=r"x\.seconds is infinite"):
        check_finite("x", Readout(math.inf, 1.0))


def test_integers_and_other_types_are_ignored() -> None:
    check_finite(
        "x", [torch.tensor([1, 2]), torch.tensor([True]), 3, "nan", b"nan", None, object(), float, AppearedPixels]
    )


def test_all_stages_are_checked(demo: RGBDSequence) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    plain = V3DSLAM(demo.camera, config=NO_NETWORK)
    callables = {name for name, value in vars(plain).items() if callable(value) and not name.startswith("_")}
    stages = {name for name, value in vars(slam).items() if isinstance(value, CheckedStage)}
    by_methods = {"loop_closer", "back_end", "motion_model"}  # these are used by their methods
    assert stages == callables - {"timer"} | by_methods
    assert {"segment", "smooth_depth", "odometry", "classify_motion", "track_camera", "mapper"} <= stages


def with_nan(tensor: Tensor) -> Tensor:
    """Return a copy whose first row is NaN."""
    return tensor.clone().index_fill_(0, torch.tensor([0]), math.nan)


OBJECT_WITHOUT_CLOUD = TrackedObject(
    id=0,
    label=0,
    mask=torch.zeros(480, 640, dtype=torch.bool),
    state=ObjectState(0.0, torch.full((3,), math.nan, dtype=torch.float64), torch.zeros(3), (1.0, 0.0, 1.0), 2.0),
    history=(),
    votes=0,
    chamfer=math.nan,
    motion_state=MotionState.UNKNOWN,
    missed=False,
    cloud=torch.full((4, 3), math.nan),
)
"""All of its fields that are NaN are documented as such, except the cloud."""


def test_state_of_a_checked_system_is_loaded_into_its_stages(demo: RGBDSequence) -> None:
    first, second = islice(demo, 2)
    slam, loaded = (CheckedSLAM(demo.camera, config=NO_NETWORK) for _ in range(2))
    slam(first)
    loaded.load_state_dict(slam.state_dict())
    assert len(loaded.map.keyframes) == 1
    assert loaded(second).status is TrackingStatus.TRACKED


@pytest.fixture
def slam(demo: RGBDSequence) -> CheckedSLAM:
    """System that has processed three frames."""
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    for index in range(3):
        slam(demo[index])
    return slam


def assert_error_in_frame_3(slam: CheckedSLAM, demo: RGBDSequence, field: str) -> None:
    """Check that the error names the field and the frame, and that the poses before are kept as last refined."""
    last_poses = [slam.poses.T_cw]
    slam.register_stage_hook("refine_previous", lambda *_: last_poses.append(slam.poses.T_cw))
    with pytest.raises(NumericsError, match=rf"^frame 3: {re.escape(field)} is NaN"):
        slam(demo[3])
    assert len(slam.poses) == 3
    assert torch.equal(slam.poses.T_cw, last_poses[-1])


@pytest.mark.parametrize(
    ("stage", "corrupt", "field"),
    [
        ("smooth_depth", with_nan, "smooth_depth"),
        ("detect_features", lambda result: replace(result, uv=with_nan(result.uv)), "detect_features.uv"),
        (
            "back_project_instances",
            lambda result: replace(result, points=torch.full((1, 1, 3), math.nan)),
            "back_project_instances.points",
        ),
        ("odometry", lambda result: replace(result, T_cp=with_nan(result.T_cp)), "odometry.T_cp"),
        (
            "classify_motion",
            lambda result: replace(result, objects=[OBJECT_WITHOUT_CLOUD]),
            "classify_motion.objects[0].cloud",
        ),
        ("track_camera", lambda result: replace(result, T_cw=with_nan(result.T_cw)), "track_camera.T_cw"),
    ],
)
def test_replaced_stage_that_returns_nan_is_named_with_field_and_frame(
    slam: CheckedSLAM, demo: RGBDSequence, stage: str, corrupt: Callable[[Any], Any], field: str
) -> None:
    replaced = getattr(slam, stage)
    setattr(slam, stage, lambda *args, **kwargs: corrupt(replaced(*args, **kwargs)))
    assert_error_in_frame_3(slam, demo, field)


@pytest.mark.parametrize(
    ("stage", "corrupt", "field"),
    [
        ("estimate_motion", lambda result: replace(result, T_ba=with_nan(result.T_ba)), "estimate_motion.T_ba"),
        ("track_map", lambda result: replace(result, T_cw=with_nan(result.T_cw)), "track_map.T_cw"),
    ],
)
def test_stage_used_by_other_stages_that_returns_nan_is_named(
    slam: CheckedSLAM, demo: RGBDSequence, stage: str, corrupt: Callable[[Any], Any], field: str
) -> None:
    """The stages that use it hold the same wrapper."""
    wrapper = getattr(slam, stage)
    original = wrapper._stage

    def corrupted(*args: Any, **kwargs: Any) -> Any:
        return corrupt(original(*args, **kwargs))

    vars(corrupted)["refine"] = getattr(original, "refine", None)  # with which `track_map` refines the previous frame
    wrapper._stage = corrupted
    assert_error_in_frame_3(slam, demo, field)


def test_infinite_box_is_attributed_to_the_segmenter(demo: RGBDSequence) -> None:
    def segment(frame: RGBDFrame) -> Instances:
        return replace(Instances.empty(480, 640), boxes=torch.full((1, 4), math.inf))

    with pytest.raises(NumericsError, match=r"^frame 0: segment\.boxes is infinite: 4 of 4"):
        CheckedSLAM(demo.camera, segment, NO_NETWORK)(demo[0])


def test_instance_with_too_few_pixels_for_its_appearance_is_accepted(demo: RGBDSequence) -> None:
    def segment(frame: RGBDFrame) -> Instances:
        mask = torch.zeros(1, 480, 640, dtype=torch.bool)
        mask[:, 200:204, 300:304] = True  # one counted pixel
        return Instances(mask, torch.tensor([0]), torch.tensor([0.9]), torch.tensor([[300.0, 200.0, 304.0, 204.0]]))

    slam = CheckedSLAM(demo.camera, segment, NO_NETWORK)
    appearances: list[Tensor] = []
    slam.register_stage_hook("describe_appearance", lambda _, arguments, result: appearances.append(result))
    for index in range(2):
        slam(demo[index])
    assert appearances[0].isnan().all()


def test_infinite_appearance_is_rejected(demo: RGBDSequence) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    slam.describe_appearance = lambda image, masks: torch.full((len(masks), 4), math.inf)
    with pytest.raises(NumericsError, match=r"describe_appearance is infinite"):
        slam.describe_appearance(demo[0].image, torch.ones(1, 480, 640, dtype=torch.bool))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda frame: replace(frame, depth=frame.depth.clone().fill_(math.nan)), "depth is NaN"),
        (lambda frame: replace(frame, depth=frame.depth.clone().fill_(math.inf)), "depth is infinite"),
        (lambda frame: replace(frame, stamp=math.nan), "stamp is NaN"),
    ],
)
def test_frame_with_non_finite_numbers_is_rejected(
    demo: RGBDSequence, change: Callable[[RGBDFrame], RGBDFrame], field: str
) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    slam(demo[0])
    with pytest.raises(NumericsError, match=rf"^frame 1: the input\.{field}"):
        slam(change(demo[1]))


def test_nan_in_the_map_is_found(demo: RGBDSequence) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    slam(demo[0])
    landmarks, nan = slam.map.landmarks, torch.full((1, 3), math.nan, dtype=torch.float64)
    rows = {name: column[:1].clone() for name, column in landmarks.columns.items()}
    landmarks.append(**{**rows, "point": nan})
    with pytest.raises(NumericsError, match=r"^frame 1: .*NaN"):
        slam(demo[1])


def run_frames(system: type[V3DSLAM], sequence: RGBDSequence, masks: Path, frames: int) -> bytes:
    slam = system(sequence.camera, MaskFolder(masks), load_config(None, ("segmentation.source=masks",)))
    lines = []
    for frame in islice(iter(sequence), frames):
        result = slam(frame)
        objects = [(each.id, each.votes, each.motion_state, each.centroid.tolist()) for each in result.objects]
        lines.append(repr((result.T_wc.tolist(), result.status, objects, int(result.static_mask.sum()))))
    T_wc = slam.poses.trajectory().T_wc
    return "\n".join(lines).encode() + T_wc.numpy().tobytes()


def test_checked_demo_with_people_gives_the_same_results(moment: Path) -> None:
    sequence = load_sequence(str(moment))
    plain, checked = (run_frames(system, sequence, moment / "masks", 6) for system in (V3DSLAM, CheckedSLAM))
    assert b"MotionState" in plain
    assert plain == checked


@pytest.mark.parametrize("name", ["walkers_room", "crowd_rpy"])
def test_checked_recorded_images_give_the_same_results(real_sequence: Callable[[str], Path], name: str) -> None:
    folder = real_sequence(name)
    sequence = load_sequence(str(folder))
    plain, checked = (run_frames(system, sequence, folder / "masks", 8) for system in (V3DSLAM, CheckedSLAM))
    assert plain == checked


@pytest.mark.usefixtures("undrawn")
def test_run_with_check_ends_at_nan_and_keeps_the_frames_before(demo: RGBDSequence, tmp_path: Path) -> None:
    def segment(frame: RGBDFrame) -> Instances:
        return replace(Instances.empty(480, 640), boxes=torch.full((frame.index // 2, 4), math.nan))

    config = load_config(None, ("segmentation.source=none", "check_numerics=true"))
    run = Run(RunRequest("demo", config), demo, segment, tmp_path)
    run(lambda *_: None)
    assert run.pipeline.record.failure == "frame 2: segment.boxes is NaN: 4 of 4 numbers, the first at [0, 0]"
    assert len(read_trajectory(tmp_path / "trajectory.txt")) == 2


def test_nan_of_the_motion_model_is_attributed_to_it(demo: RGBDSequence) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    for index in range(2):
        slam(demo[index])
    slam.motion_model.velocity = torch.full((6,), math.nan, dtype=torch.float64)
    with pytest.raises(NumericsError, match=r"motion_model\.predict\.velocity is NaN"):
        slam(demo[2])
