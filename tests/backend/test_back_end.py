"""What is solved behind the camera: when it is taken in, by which thread it is solved, what happens when it fails."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

import v3d_torch.backend.back_end
from v3d_torch import V3DSLAM, RGBDFrame, load_sequence
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.mapping.local_bundle_adjustment import LocalAdjustment, local_bundle_adjust
from v3d_torch.pipeline import Pipeline

FRAMES = 6


@pytest.fixture(scope="module")
def demo() -> RGBDSequence:
    return load_sequence("demo")


def config(*, behind: bool) -> Config:
    """A keyframe every other frame."""
    chosen = ("segmentation.source=none", "mapping.max_keyframe_interval=2", "mapping.redundant_ratio=1")
    return load_config(None, (*chosen, f"prefetch={str(behind).lower()}"))


def keyframe_poses(slam: V3DSLAM) -> Tensor:
    return slam.mapper.map.T_cw


@pytest.mark.parametrize("behind", [True, False])
def test_it_is_taken_in_with_the_next_frame(behind: bool, demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames 0, 2 and 4 become keyframes: what is solved for them changes the map with frames 1, 3 and 5."""
    solved: list[tuple[int, str]] = []
    taken_in: list[int] = []

    def adjust(*args: object) -> LocalAdjustment | None:
        solved.append((args[1].frame, threading.current_thread().name))  # type: ignore[attr-defined]
        return local_bundle_adjust(*args)  # type: ignore[arg-type]

    take_in = LocalAdjustment.apply

    def noted(self: LocalAdjustment, *args: object) -> None:
        taken_in.append(index)
        take_in(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(v3d_torch.backend.back_end, "local_bundle_adjust", adjust)
    monkeypatch.setattr(LocalAdjustment, "apply", noted)
    slam = V3DSLAM(demo.camera, config=config(behind=behind))
    poses = []
    for index in range(FRAMES):
        slam(demo[index])
        poses.append(keyframe_poses(slam))
    assert [keyframe.frame for keyframe in slam.mapper.map.keyframes] == [0, 2, 4]
    assert [frame for frame, _ in solved] == [0, 2, 4]
    assert taken_in == [3, 5]  # a first keyframe alone has nothing to be adjusted to
    assert torch.equal(poses[2][:1], poses[1]) and torch.equal(poses[4][:2], poses[3])
    assert not torch.equal(poses[3], poses[2]) and not torch.equal(poses[5], poses[4])
    here = threading.current_thread().name
    assert {name == here for _, name in solved} == {not behind}


def test_what_is_left_is_taken_in_after_the_last_frame(demo: RGBDSequence) -> None:
    """A second time, or before any frame, there is nothing."""
    slam = V3DSLAM(config=config(behind=True))
    slam.flush()
    for index in range(5):
        slam(demo[index])
    before = keyframe_poses(slam)
    assert slam.back_end.keyframe is slam.mapper.map.keyframes[-1]
    slam.flush()
    after = keyframe_poses(slam)
    assert slam.back_end.keyframe is None and not torch.equal(before, after)
    slam.flush()
    assert torch.equal(keyframe_poses(slam), after)
    assert torch.equal(slam.poses.T_cw, slam.mapper.map.keyframes[-1].T_cw)  # the last frame goes along
    assert slam(demo[5]).T_wc.isfinite().all()


def test_what_breaks_behind_is_told_where_it_is_taken_in(demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*args: object) -> LocalAdjustment:
        raise ZeroDivisionError("no good")

    monkeypatch.setattr(v3d_torch.backend.back_end, "local_bundle_adjust", broken)
    slam = V3DSLAM(demo.camera, config=config(behind=True))
    slam(demo[0])
    with pytest.raises(ZeroDivisionError, match="no good"):
        slam(demo[1])


def test_a_system_that_is_forgotten_leaves_no_thread(demo: RGBDSequence) -> None:
    before = set(threading.enumerate())
    slam = V3DSLAM(demo.camera, config=config(behind=True))
    slam(demo[0])
    slam.flush()
    (thread,) = set(threading.enumerate()) - before
    del slam
    gc.collect()
    thread.join(timeout=10)
    assert not thread.is_alive()


class Short:
    """Some frames of the demo."""

    name, groundtruth = "short", None

    def __init__(self, demo: RGBDSequence) -> None:
        self._demo = demo
        self.camera = demo.camera

    def __iter__(self) -> Iterator[RGBDFrame]:
        return (self._demo[index] for index in range(FRAMES))


def test_a_run_without_gradients_gives_what_calls_with_them_give(demo: RGBDSequence) -> None:
    pipeline = Pipeline(Short(demo), V3DSLAM(demo.camera, config=config(behind=True)))
    assert pipeline().failure is None
    pipeline.flush()
    slam = V3DSLAM(demo.camera, config=config(behind=False))
    for index in range(FRAMES):
        slam(demo[index])
    slam.flush()
    assert torch.equal(slam.poses.trajectory().T_wc, pipeline.slam.poses.trajectory().T_wc)
    assert torch.equal(slam.mapper.map.landmarks["point"], pipeline.slam.mapper.map.landmarks["point"])
