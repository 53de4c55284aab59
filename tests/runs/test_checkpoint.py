"""A resumed run equals an uninterrupted one in every attribute, to the bit; state files and their errors."""

from __future__ import annotations

import types
from collections import deque
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
from v3d_torch.frame_result import FrameResult
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.state_file import read_state, write_state
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.pipeline import FrameCallback, Pipeline
from v3d_torch.runs.checkpoint import CHECKPOINT, describe_change, read_checkpoint, write_checkpoint
from v3d_torch.runs.request import RunRequest
from v3d_torch.segmentation import NoSegmentation, UprightSegmenter
from v3d_torch.types import Instances, RGBDFrame, TrackingStatus, Trajectory, segmenter_state_of

CAMERA = PinholeCamera(fx=130.0, fy=130.0, cx=79.5, cy=59.5, width=160, height=120)
FORWARD, DARK, BACKWARD = range(0, 180, 9), [180] * 12, range(360, 60, -10)
"""Columns of the wall at the left border of the images: forward, in the dark, and backward from farther on."""
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
    """Sequence along a textured wall, with a walking red person, sometimes not detected, and an unlabelled box."""

    name = "walk"
    camera = CAMERA
    groundtruth: Trajectory | None = None

    def __init__(self) -> None:
        noise = np.random.default_rng(0).integers(0, 200, (30, 140, 3), dtype=np.uint8)
        self._wall = cv2.resize(noise, (560, 120), interpolation=cv2.INTER_CUBIC)
        self._columns = [*FORWARD, *DARK, *BACKWARD]
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
        if index in range(len(FORWARD), len(FORWARD) + len(DARK)):
            image[:], depth[:] = 0, 0
        return RGBDFrame(
            index, float(self.stamps[index]), torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(depth)[None]
        )

    def motion_mask(self, index: int) -> Tensor:
        return (self[index].image[0] >= 254).to(torch.uint8)


def segment_red(frame: RGBDFrame) -> Instances:
    """Segment the red person, with a higher score if upright; misses it in every fourth frame."""
    red, height, width = frame.image[0], *frame.image.shape[1:]
    mask = red >= 254
    if frame.index % 4 == 3 or not mask.any():
        return Instances.empty(height, width)
    rows = torch.arange(height)[:, None].expand(height, width)
    upright = rows[red == 255].float().mean() < rows[red == 254].float().mean()
    score = torch.tensor([0.9 if upright else 0.4])
    return Instances(mask[None], torch.tensor([0]), score, torch.zeros(1, 4))


def make_pipeline(*, prefetch: bool) -> Pipeline:
    config = CONFIG.model_copy(update={"prefetch": prefetch})
    return Pipeline(Walk(), V3DSLAM(CAMERA, UprightSegmenter(segment_red), config))


@pytest.fixture(scope="module")
def uninterrupted() -> Pipeline:
    """Pipeline that has run without interruption."""
    pipeline = make_pipeline(prefetch=False)
    assert pipeline().failure is None
    return pipeline


def test_sequence_exercises_all_state(uninterrupted: Pipeline) -> None:
    slam, rows = uninterrupted.slam, uninterrupted.record.dynamics
    statuses = slam.poses.statuses
    assert {TrackingStatus.TRACKED, TrackingStatus.LOST, TrackingStatus.DISCONNECTED} & set(statuses) >= {
        TrackingStatus.TRACKED,
        TrackingStatus.LOST,
    }
    assert slam.loop_closer.loop_count > 0 and len(slam.map.keyframes) > 10
    assert not slam.map.landmarks["active"].all()
    assert {"person", "unlabelled"} <= {str(row["class"]) for row in rows}
    assert {"dynamic", "static"} <= {str(row["motion_state"]) for row in rows}
    assert any(row["missed"] for row in rows) and any(row["votes"] for row in rows)
    state = segmenter_state_of(slam.segment)
    assert state is not None and state["calls"] > 10 and state["up"].norm() > 1


TIMED_STAGES = (
    *("segmentation", "depth", "features", "motion", "free_space", "clouds", "objects", "tracking", "mapping"),
    *("bundle", "loop"),
)
"""Stages whose measured times are not compared."""


def differences(a: Any, b: Any, path: str, compared: dict[int, Any]) -> Iterator[str]:
    """Compare two objects recursively, attribute by attribute, except measured times.

    Args:
        a: First object.
        b: Second object.
        path: Path of the objects in the messages.
        compared: Pairs of objects compared so far by the identity of the first, empty at first: objects shared within
            ``a`` must be shared within ``b``.

    Yields:
        Path of each difference.
    """
    if type(a) is not type(b):
        yield f"{path}: {type(a)} and {type(b)}"
    elif isinstance(a, Config):  # differ in prefetching
        pass
    elif isinstance(a, Tensor):
        if a.dtype != b.dtype or a.shape != b.shape or not torch.equal(a.nan_to_num(), b.nan_to_num()):
            yield path
    elif isinstance(a, np.ndarray):
        if not np.array_equal(a, b):
            yield path
    elif isinstance(a, (dict, list, tuple, deque)):
        pairs = [(str(key), x) for key, x in (a.items() if isinstance(a, dict) else enumerate(a))]
        others = list(b.values()) if isinstance(a, dict) else list(b)
        if len(pairs) != len(others) or (isinstance(a, dict) and list(a) != list(b)):
            yield path
        else:
            for (name, x), y in zip(pairs, others, strict=True):
                if name not in ("read", "seconds", *TIMED_STAGES):
                    yield from differences(x, y, f"{path}.{name}", compared)
    elif isinstance(a, faiss.IndexBinaryHash):
        if a.ntotal != b.ntotal:
            yield path
    elif isinstance(a, partial):
        yield from differences(a.keywords, b.keywords, path, compared)
    elif isinstance(a, (types.FunctionType, types.MethodType, types.BuiltinFunctionType, torch.Generator)):
        pass
    elif hasattr(a, "__dict__") and not isinstance(a, (str, type, BaseModel, PinholeCamera)):
        if id(a) in compared:
            if compared[id(a)][1] is not b:
                yield f"{path}: is another object"
            return
        compared[id(a)] = a, b
        cached = {name for name in dir(type(a)) if isinstance(getattr(type(a), name, None), cached_property)}
        # Measured times, and the threads of a pipeline with prefetching.
        skipped = cached | {"timer", "_thread", "_executor", "_get_result"}
        if not isinstance(a, Readout):  # its seconds are not the time of a stage
            skipped.add("seconds")
        first, second = ({key: value for key, value in vars(x).items() if key not in skipped} for x in (a, b))
        yield from differences(dict(sorted(first.items())), dict(sorted(second.items())), path, compared)
    elif not (a == b or (a != a and b != b)):
        yield f"{path}: {a} and {b}"


def test_comparison_finds_differences_in_private_attributes() -> None:
    first, second = make_pipeline(prefetch=False), make_pipeline(prefetch=False)
    assert list(differences(first, second, "run", {})) == []
    second.slam.mapper._most_tracked = 3
    second.slam.classify_motion.tracker._next_id = 4
    assert len(list(differences(first, second, "run", {}))) == 2


def interrupt_after(stop: int) -> FrameCallback:
    def on_frame(frame: RGBDFrame, result: FrameResult) -> None:
        if frame.index == stop:
            raise KeyboardInterrupt

    return on_frame


def test_run_resumed_many_times_equals_an_uninterrupted_run(uninterrupted: Pipeline, tmp_path: Path) -> None:
    """With prefetching, so that the segmenter is some frames ahead of the saved state."""
    request = RunRequest("walk", CONFIG.model_copy(update={"prefetch": True}), save_masks=True)
    pipeline = make_pipeline(prefetch=True)
    for stop in STOPS:
        record = pipeline(interrupt_after(stop))
        assert record.failure == f"interrupted after {stop + 1} of {len(Walk())} frames"
        assert pipeline.between_frames
        write_checkpoint(tmp_path, pipeline, request)
        checkpoint = read_checkpoint(tmp_path)
        assert (checkpoint.frames, checkpoint.request.config) == (stop + 1, pipeline.slam.config)
        assert checkpoint.request == request.absolute() and checkpoint.request.save_masks
        pipeline = make_pipeline(prefetch=True)
        assert describe_change(checkpoint, pipeline.sequence) is None
        pipeline.load_state_dict(checkpoint.state)
    assert pipeline().failure is None
    assert list(differences(uninterrupted, pipeline, "pipeline", {})) == []
    slam, expected = pipeline.slam, uninterrupted.slam
    assert torch.equal(slam.poses.trajectory().T_wc, expected.poses.trajectory().T_wc)
    assert set(slam.timer.seconds) == set(expected.timer.seconds)
    assert [row["frame"] for row in pipeline.record.frames] == list(range(len(Walk())))
    # The database of loop closing is rebuilt and gives the same candidates.
    query = expected.map.keyframes[3].features.descriptors
    assert slam.loop_closer._database.query(query, 9) == expected.loop_closer._database.query(query, 9)


# --- save_state and load_state


def test_loaded_system_equals_the_saved_one(tmp_path: Path) -> None:
    config = load_config(overrides=["segmentation.source=none", "features.count=300"])
    walk, uninterrupted, saved = Walk(), V3DSLAM(CAMERA, config=config), V3DSLAM(CAMERA, config=config)
    for frame in (walk[0], walk[1], walk[2]):
        uninterrupted(frame), saved(frame)
    save_state(tmp_path / "slam.state", saved)
    loaded = load_state(tmp_path / "slam.state")
    assert loaded.camera == CAMERA
    for frame in (walk[3], walk[4]):
        assert torch.equal(loaded(frame).T_wc, uninterrupted(frame).T_wc)
    assert loaded.config == config and list(differences(uninterrupted, loaded, "slam", {})) == []


@pytest.mark.parametrize("saved_after", [0, 1, 14, 24, 38])
def test_loaded_system_gives_the_same_next_results(saved_after: int, tmp_path: Path) -> None:
    """With objects, a stateful segmenter, a lost camera and a pending keyframe."""
    config, walk = CONFIG.model_copy(update={"prefetch": False}), Walk()
    slam = V3DSLAM(CAMERA, UprightSegmenter(segment_red), config)
    for index in range(saved_after):
        slam(walk[index])
    save_state(tmp_path / "slam.state", slam)
    loaded = load_state(tmp_path / "slam.state", UprightSegmenter(segment_red))
    assert list(differences(slam.state_dict(), loaded.state_dict(), "state", {})) == []
    for index in range(saved_after, saved_after + 8):
        assert list(differences(slam(walk[index]), loaded(walk[index]), f"frame {index}", {})) == []
    slam.flush(), loaded.flush()
    assert list(differences(slam, loaded, "slam", {})) == []


@pytest.mark.parametrize("stage", ["mapper", "classify_motion", "free_space_check"])
def test_system_with_a_replaced_stage_without_state_is_not_saved(stage: str, tmp_path: Path) -> None:
    slam = V3DSLAM(CAMERA, NoSegmentation(), CONFIG)
    setattr(slam, stage, lambda *_: None)
    with pytest.raises(ConfigError, match=f"^{stage} was replaced by a stage without state_dict; its state cannot be"):
        save_state(tmp_path / "slam.state", slam)
    assert list(tmp_path.iterdir()) == []


def test_checkpoint_is_not_loaded_as_the_state_of_a_system(tmp_path: Path) -> None:
    pipeline = make_pipeline(prefetch=False)
    pipeline(interrupt_after(1))
    write_checkpoint(tmp_path, pipeline, RunRequest("walk", CONFIG))
    with pytest.raises(InputError, match=rf"{CHECKPOINT}: is "):
        load_state(tmp_path / CHECKPOINT)


# --- state files


def write_value(path: Path, value: object = 1) -> bytes:
    write_state(path, {"about": "a test"}, {"value": value})
    return path.read_bytes()


def test_state_is_read_back_with_shared_tensors(tmp_path: Path) -> None:
    shared = torch.arange(6).view(2, 3)
    write_state(tmp_path / "s", {"ä": [1.5, float("inf")]}, {"a": shared, "b": [shared[1], float("nan")], "c": {1, 2}})
    about, state = read_state(tmp_path / "s", [set])
    assert about["ä"] == [1.5, float("inf")] and state["c"] == {1, 2}
    state["a"][1, 0] = 7
    assert state["b"][0].tolist() == [7, 4, 5] and state["b"][1] != state["b"][1]


def test_damaged_state_file_is_rejected(tmp_path: Path) -> None:
    content = write_value(tmp_path / "s", torch.ones(50))
    for damaged in (
        *(b"", b"v3d_torch state 4\n", b"\xff" * 300, content[:100], content[: len(content) // 2], content[:-1]),
        *(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :] for at in range(3, len(content), 97)),
    ):
        (tmp_path / "s").write_bytes(damaged)
        with pytest.raises(InputError, match=r"/s: (is damaged or not a state of a run|has state format)"):
            read_state(tmp_path / "s", [])
    with pytest.raises(InputError, match=r"cannot be read \(No such file"):
        read_state(tmp_path / "none", [])


class RunsCode:
    """Object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.path,))


def test_reading_runs_no_code_and_creates_allowed_classes_only(tmp_path: Path) -> None:
    write_value(tmp_path / "s", RunsCode(tmp_path / "created"))
    with pytest.raises(InputError, match="damaged or not a state"):
        read_state(tmp_path / "s", [Walk])
    assert not (tmp_path / "created").exists()
    write_value(tmp_path / "s", CAMERA)
    with pytest.raises(InputError, match="damaged or not a state"):
        read_state(tmp_path / "s", [Walk])
    assert read_state(tmp_path / "s", [PinholeCamera])[1]["value"] == CAMERA


def test_state_of_another_version_or_content_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = write_value(tmp_path / "s")
    (tmp_path / "s").write_bytes(content.replace(b"state 10 ", b"state 9 ", 1))
    with pytest.raises(InputError, match=r"/s: has state format 9, .* reads format 10"):
        read_state(tmp_path / "s", [])
    with monkeypatch.context() as patch:
        patch.setattr("v3d_torch.io.state_file.version", lambda _: "9.9")
        write_value(tmp_path / "s")
    with pytest.raises(InputError, match=r"/s: was written by v3d-torch 9\.9, this is"):
        read_state(tmp_path / "s", [])
    with pytest.raises(
        InputError, match=r"slam\.state: is not the state of a system; pass a file that save_state wrote"
    ):
        write_value(tmp_path / "slam.state")
        load_state(tmp_path / "slam.state")


@pytest.mark.parametrize("free", [0, 50, 3000])
def test_full_disk_keeps_the_previous_state(free: int, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    previous = write_value(tmp_path / "s")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free, hard))
    try:
        with pytest.raises(OutputError, match="/s: cannot be written"):
            write_value(tmp_path / "s", torch.ones(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "s").read_bytes() == previous and len(list(tmp_path.iterdir())) == 1
    assert CHECKPOINT not in {path.name for path in tmp_path.iterdir()}
