"""A run that goes on from its checkpoint is the run that was never stopped: to the last attribute and bit."""

from __future__ import annotations

import types
from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import cv2
import faiss
import numpy as np
import pytest
import torch
from pydantic import BaseModel
from torch import Tensor

from v3d_torch import V3DSLAM, load_state, save_state
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError, InputError, OutputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.state_file import read_state, write_state
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.checkpoint import CHECKPOINT, describe_change, read_checkpoint, restore, write_checkpoint
from v3d_torch.runs.request import RunRequest
from v3d_torch.segmentation import NoSegmentation, UprightSegmenter
from v3d_torch.types import Instances, RGBDFrame, TrackingStatus, Trajectory, segmenter_state_of

CAMERA = PinholeCamera(fx=130.0, fy=130.0, cx=79.5, cy=59.5, width=160, height=120)
THERE, DARK, BACK = range(0, 180, 9), [180] * 12, range(360, 60, -10)
"""Columns of the wall that the camera goes along, is carried past in the dark, and comes back over."""
CONFIG = load_config(
    overrides=[
        *("features.count=400", "features.levels=4", "mapping.max_keyframe_interval=3", "mapping.min_tracked=30"),
        *(
            "mapping.landmarks_per_keyframe=200",
            "loop.min_keyframe_gap=2",
            "loop.min_inliers=20",
            "loop.min_inlier_ratio=0.1",
        ),
        *("objects.clouds.stride=1", "objects.clouds.min_points=10", "objects.free_space.min_points=10"),
    ]
)
STOPS = (0, 1, 7, 8, 19, 22, 31, 32, 33, 45, 53)


class Walk:
    """A wall of noise, somebody red who walks before it, now and then unseen, and a box that nobody knows."""

    name = "walk"
    camera = CAMERA
    groundtruth: Trajectory | None = None

    def __init__(self) -> None:
        noise = np.random.default_rng(0).integers(0, 200, (30, 140, 3), dtype=np.uint8)
        self._wall = cv2.resize(noise, (560, 120), interpolation=cv2.INTER_CUBIC)
        self._columns = [*THERE, *DARK, *BACK]
        self.stamps = torch.arange(len(self), dtype=torch.float64) / 10

    def __len__(self) -> int:
        return len(self._columns)

    def __iter__(self) -> Iterator[RGBDFrame]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> RGBDFrame:
        if not 0 <= index < len(self):
            raise IndexError(index)
        column = self._columns[index]
        image = self._wall[:, column : column + 160].copy()
        depth = np.full((120, 160), 2.0, np.float32)
        walker, box = 10 + 6 * (index % 20), 120 - 5 * (index % 16)
        image[30:110, walker : walker + 24] = 255, 0, 0
        image[70:110, walker : walker + 24] = 254, 0, 0  # the legs
        depth[30:110, walker : walker + 24] = 1.5
        image[5:28, box : box + 26] //= 2
        depth[5:28, box : box + 26] = 1.2
        if index in range(len(THERE), len(THERE) + len(DARK)):
            image[:], depth[:] = 0, 0
        return RGBDFrame(
            index, float(self.stamps[index]), torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(depth)[None]
        )

    def who_moves(self, index: int) -> Tensor:
        return (self[index].image[0] >= 254).to(torch.uint8)


def network(frame: RGBDFrame) -> Instances:
    """Sees who is red, surest when they stand on their legs; misses them in every fourth frame."""
    red, height, width = frame.image[0], *frame.image.shape[1:]
    mask = red >= 254
    if frame.index % 4 == 3 or not mask.any():
        return Instances.empty(height, width)
    rows = torch.arange(height)[:, None].expand(height, width)
    upright = rows[red == 255].float().mean() < rows[red == 254].float().mean()
    score = torch.tensor([0.9 if upright else 0.4])
    return Instances(mask[None], torch.tensor([0]), score, torch.zeros(1, 4))


def pipeline(*, ahead: bool) -> Pipeline:
    config = CONFIG.model_copy(update={"prefetch": ahead})
    return Pipeline(Walk(), V3DSLAM(CAMERA, UprightSegmenter(network), config))


@pytest.fixture(scope="module")
def whole() -> Pipeline:
    """Never stopped."""
    run = pipeline(ahead=False)
    assert run().failure is None
    return run


def test_the_scene_has_all_that_may_be_remembered(whole: Pipeline) -> None:
    statuses, slam, rows = whole.slam.poses.statuses, whole.slam, whole.record.dynamics
    assert {TrackingStatus.TRACKED, TrackingStatus.LOST, TrackingStatus.DISCONNECTED} & set(statuses) >= {
        TrackingStatus.TRACKED,
        TrackingStatus.LOST,
    }
    assert slam.loop_closer.loop_count > 0 and len(slam.mapper.map.keyframes) > 10
    assert not slam.mapper.map.landmarks["active"].all()
    assert {"person", "unnamed"} <= {str(row["class"]) for row in rows}
    assert {"dynamic", "static"} <= {str(row["motion_state"]) for row in rows}
    assert any(row["missed"] for row in rows) and any(row["votes"] for row in rows)
    state = segmenter_state_of(slam.segment)
    assert state is not None and state["calls"] > 10 and state["up"].norm() > 1


def differences(a: Any, b: Any, where: str, same: dict[int, Any]) -> Iterator[str]:
    """Where two objects differ, looked through to their last attributes; but for times that were measured."""
    if type(a) is not type(b):
        yield f"{where}: {type(a)} and {type(b)}"
    elif isinstance(a, Config):  # one looks ahead, the other does not
        pass
    elif isinstance(a, Tensor):
        if a.dtype != b.dtype or a.shape != b.shape or not torch.equal(a.nan_to_num(), b.nan_to_num()):
            yield where
    elif isinstance(a, np.ndarray):
        if not np.array_equal(a, b):
            yield where
    elif isinstance(a, (dict, list, tuple)):
        pairs = [(str(i), x) for i, x in (a.items() if isinstance(a, dict) else enumerate(a))]
        others = list(b.values()) if isinstance(a, dict) else list(b)
        if len(pairs) != len(others) or (isinstance(a, dict) and list(a) != list(b)):
            yield where
        else:
            for (name, x), y in zip(pairs, others, strict=True):
                if name not in ("read", "seconds", *CLOCKED):
                    yield from differences(x, y, f"{where}.{name}", same)
    elif isinstance(a, faiss.IndexBinaryHash):
        if a.ntotal != b.ntotal:
            yield where
    elif isinstance(a, partial):
        yield from differences(a.keywords, b.keywords, where, same)
    elif isinstance(a, (types.FunctionType, types.MethodType, types.BuiltinFunctionType, torch.Generator)):
        pass
    elif hasattr(a, "__dict__") and not isinstance(a, (str, type, BaseModel, PinholeCamera)):
        if id(a) in same:  # what is shared in one is shared in the other
            if same[id(a)][1] is not b:
                yield f"{where}: is another object"
            return
        same[id(a)] = a, b
        cached = {name for name in dir(type(a)) if isinstance(getattr(type(a), name, None), cached_property)}
        # One optimises in the background, the other does not.
        skipped = cached | {"clock", "seconds", "_thread", "_executor", "_get_result"}
        first, second = ({key: value for key, value in vars(x).items() if key not in skipped} for x in (a, b))
        yield from differences(dict(sorted(first.items())), dict(sorted(second.items())), where, same)
    elif not (a == b or (a != a and b != b)):
        yield f"{where}: {a} and {b}"


CLOCKED = (
    "segmentation",
    "depth",
    "features",
    "clouds",
    "motion",
    "background",
    "objects",
    "tracking",
    "mapping",
    "bundle",
    "loop",
)
"""Stages, in a row of seconds."""


def test_differences_are_found() -> None:
    first, second = pipeline(ahead=False), pipeline(ahead=False)
    assert list(differences(first, second, "run", {})) == []
    second.slam.mapper._most_tracked = 3
    second.slam.classify_motion.tracker._next_id = 4
    assert len(list(differences(first, second, "run", {}))) == 2


def stop_at(stop: int) -> Any:
    def on_frame(frame: RGBDFrame, scene: FrameObjects, status: TrackingStatus) -> None:
        if frame.index == stop:
            raise KeyboardInterrupt

    return on_frame


def test_stopped_ever_again_it_is_as_if_it_never_was(whole: Pipeline, tmp_path: Path) -> None:
    """With the frame after looked at ahead: what the segmentation then remembers is of a frame too late."""
    request = RunRequest("walk", save_masks=True)
    run = pipeline(ahead=True)
    for stop in STOPS:
        assert (
            run(stop_at(stop)).failure == f"interrupted after {stop + 1} of {len(Walk())} frames" and run.between_frames
        )
        write_checkpoint(tmp_path, run, request)
        checkpoint = read_checkpoint(tmp_path)
        assert (checkpoint.frames, checkpoint.config) == (stop + 1, run.slam.config)
        assert checkpoint.request.save_masks
        run = pipeline(ahead=True)
        assert describe_change(checkpoint, run.sequence) is None
        restore(run, checkpoint)
    assert run().failure is None
    found = list(differences(whole, run, "pipeline", {}))
    assert found == []
    assert torch.equal(run.slam.poses.trajectory().T_wc, whole.slam.poses.trajectory().T_wc)
    assert set(run.slam.timer.seconds) == set(whole.slam.timer.seconds)
    assert [row["frame"] for row in run.record.frames] == list(range(len(Walk())))
    # Places are recognised as before.
    query = whole.slam.mapper.map.keyframes[3].features.descriptors
    assert run.slam.loop_closer._database.query(query, 9) == whole.slam.loop_closer._database.query(query, 9)


# --- by hand, in Python


def test_a_system_is_saved_and_loaded_between_two_frames(tmp_path: Path) -> None:
    config = load_config(overrides=["segmentation.source=none", "features.count=300"])
    walk, through, saved = Walk(), V3DSLAM(CAMERA, config=config), V3DSLAM(CAMERA, config=config)
    for frame in (walk[0], walk[1], walk[2]):
        through(frame), saved(frame)
    save_state(tmp_path / "slam.state", saved)
    loaded = load_state(tmp_path / "slam.state")
    for frame in (walk[3], walk[4]):
        assert torch.equal(loaded(frame).T_wc, through(frame).T_wc)
    assert loaded.config == config and list(differences(through, loaded, "slam", {})) == []


def test_what_has_no_known_state_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="mapper"):
        save_state(tmp_path / "slam.state", V3DSLAM(segment=NoSegmentation()))  # of which camera?
    assert list(tmp_path.iterdir()) == []


# --- files


def small(path: Path, value: object = 1) -> bytes:
    write_state(path, {"about": "a test"}, {"value": value})
    return path.read_bytes()


def test_a_state_comes_back_and_what_was_shared_is(tmp_path: Path) -> None:
    shared = torch.arange(6).view(2, 3)
    write_state(tmp_path / "s", {"ä": [1.5, float("inf")]}, {"a": shared, "b": [shared[1], float("nan")], "c": {1, 2}})
    about, state = read_state(tmp_path / "s", [set])
    assert about["ä"] == [1.5, float("inf")] and state["c"] == {1, 2}
    state["a"][1, 0] = 7
    assert state["b"][0].tolist() == [7, 4, 5] and state["b"][1] != state["b"][1]


def test_damage_is_told(tmp_path: Path) -> None:
    whole = small(tmp_path / "s", torch.ones(50))
    for content in (
        *(b"", b"v3d_torch state 4\n", b"\xff" * 300, whole[:100], whole[: len(whole) // 2], whole[:-1]),
        *(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :] for place in range(3, len(whole), 97)),
    ):
        (tmp_path / "s").write_bytes(content)
        with pytest.raises(InputError, match=r"/s: (is damaged or not a state of a run|has state format)"):
            read_state(tmp_path / "s", [])
    with pytest.raises(InputError, match=r"cannot be read \(No such file"):
        read_state(tmp_path / "none", [])


class Trap:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.path,))


def test_no_code_of_a_file_is_run_and_no_other_class_made(tmp_path: Path) -> None:
    small(tmp_path / "s", Trap(tmp_path / "sprung"))
    with pytest.raises(InputError, match="damaged or not a state"):
        read_state(tmp_path / "s", [Walk])
    assert not (tmp_path / "sprung").exists()
    small(tmp_path / "s", CAMERA)
    with pytest.raises(InputError, match="damaged or not a state"):
        read_state(tmp_path / "s", [Walk])
    assert read_state(tmp_path / "s", [PinholeCamera])[1]["value"] == CAMERA


def test_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = small(tmp_path / "s")
    (tmp_path / "s").write_bytes(whole.replace(b"state 8 ", b"state 9 ", 1))
    with pytest.raises(InputError, match=r"/s: has state format 9, .* reads format 8"):
        read_state(tmp_path / "s", [])
    with monkeypatch.context() as patch:
        patch.setattr("v3d_torch.io.state_file.version", lambda _: "9.9")
        small(tmp_path / "s")
    with pytest.raises(InputError, match=r"/s: was written by v3d-torch 9\.9, this is"):
        read_state(tmp_path / "s", [])
    with pytest.raises(InputError, match=r"slam\.state: is the state of something else"):
        small(tmp_path / "slam.state")
        load_state(tmp_path / "slam.state")


@pytest.mark.parametrize("room", [0, 50, 3000])
def test_a_full_disk_leaves_the_state_before(room: int, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    before = small(tmp_path / "s")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        with pytest.raises(OutputError, match="/s: cannot be written"):
            small(tmp_path / "s", torch.ones(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "s").read_bytes() == before and len(list(tmp_path.iterdir())) == 1
    assert CHECKPOINT not in {path.name for path in tmp_path.iterdir()}
