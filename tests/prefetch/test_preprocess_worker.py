"""A second process looks at frames: the same bytes, and nothing is lost when it cannot."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path

import pytest
import torch
from helpers.corpus.base import write_base
from torch import Tensor

import v3d_torch.prefetch.frame_prefetcher
from v3d_torch import V3DSLAM, RGBDFrame, load_sequence
from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets.stored import FrameIterator, StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.frame_result import PreprocessedFrame
from v3d_torch.prefetch.frame_prefetcher import FramePrefetcher
from v3d_torch.prefetch.preprocess_worker import PreprocessWorker
from v3d_torch.runs.numerics_check import CheckedSLAM
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.types import Instances, segmenter_state_of

NO_NETWORK = load_config(None, ("segmentation.source=none",))
SMALL = load_config(None, ("segmentation.height=192", "segmentation.width=256"))


@pytest.fixture(scope="module")
def demo() -> StoredSequence:
    sequence = load_sequence("demo")
    assert isinstance(sequence, StoredSequence)
    return sequence


def same(one: object, other: object) -> bool:
    """Whether two values, of tensors all the way down, are the same to the bit."""
    if isinstance(one, Tensor):
        return (
            isinstance(other, Tensor) and one.dtype == other.dtype and torch.equal(one.nan_to_num(), other.nan_to_num())
        )
    if hasattr(one, "__dataclass_fields__"):
        names = [field.name for field in fields(one)]  # type: ignore[arg-type]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, dict):
        return isinstance(other, dict) and one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, tuple):
        return isinstance(other, tuple) and all(map(same, one, other))
    return one == other


def without_times(percept: PreprocessedFrame) -> PreprocessedFrame:
    return replace(percept, seconds={})


def test_it_sees_what_is_seen_here_to_the_bit(demo: StoredSequence) -> None:
    """With the network, upright, and what that remembers of the frames before."""
    here, slam = V3DSLAM(demo.camera, config=SMALL), V3DSLAM(demo.camera, config=SMALL)
    outlook = here.outlook()
    with closing(PreprocessWorker(slam, demo)) as second:
        second.submit(0, outlook)
        for index in range(3):
            second.submit(index + 1, outlook)
            expected = here.preprocess(demo[index], outlook)
            seen = second.result()
            assert seen is not None and same(without_times(seen), without_times(expected))
            assert same(segmenter_state_of(slam.segment), expected.segmenter_state)
            assert set(seen.seconds) == {"read", "segmentation", "depth", "features"}
            assert seen.frame.camera is demo.camera


def test_numbers_are_checked_there_too(demo: StoredSequence) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    with closing(PreprocessWorker(slam, demo)) as second:
        second.submit(0, slam.outlook())
        seen = second.result()
    assert seen is not None and same(without_times(seen), without_times(slam.preprocess(demo[0], slam.outlook())))


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second process is begun for any number of frames."""
    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "_WORTH", 1)
    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "_cores", lambda: 2)


def tracked(
    config: Config, frames: Iterator[RGBDFrame], sequence: StoredSequence
) -> tuple[V3DSLAM, list[PreprocessedFrame]]:
    slam, given = V3DSLAM(sequence.camera, config=config), []
    with closing(FramePrefetcher(frames, slam, ahead=True)) as percepts:
        for percept in percepts:
            slam.track(percept)
            given.append(percept)
    return slam, given


@pytest.mark.usefixtures("at_once")
def test_the_trajectory_is_that_without(demo: StoredSequence) -> None:
    class Short(FrameIterator):
        @property
        def left(self) -> int:
            return max(6 - self.index, 0)

    slam, given = tracked(SMALL, Short(demo, 0), demo)
    plain, _ = tracked(SMALL, (demo[index] for index in range(6)), demo)
    assert [percept.frame.index for percept in given] == list(range(6))
    assert torch.equal(slam.poses.trajectory().T_wc, plain.poses.trajectory().T_wc)
    assert same(segmenter_state_of(slam.segment), segmenter_state_of(plain.segment))


@pytest.mark.usefixtures("at_once")
def test_when_it_dies_the_run_goes_on_without(demo: StoredSequence) -> None:
    slam, given = V3DSLAM(demo.camera, config=NO_NETWORK), []
    with closing(FramePrefetcher(iter(demo), slam, ahead=True)) as percepts:
        second = percepts._second
        assert second is not None and second._process is not None
        for percept in percepts:
            slam.track(percept)
            given.append(percept.frame.index)
            if len(given) == 3:
                assert second._process.poll() is None and second.is_alive
                second._process.kill()
            if len(given) == 7:
                assert not second.is_alive
                break
    assert given == list(range(7))


def test_what_cannot_be_sent_is_looked_at_here(demo: StoredSequence) -> None:
    def segment(frame: RGBDFrame) -> Instances:
        return NoSegmentation()(frame)

    slam = V3DSLAM(demo.camera, segment, NO_NETWORK)
    with closing(PreprocessWorker(slam, demo)) as second:
        assert not second.is_alive
        second.submit(0, None)
        assert second.result() is None
    with closing(FramePrefetcher(iter(demo), slam, ahead=True)) as percepts:
        assert percepts._second is None and percepts._thread is not None


@pytest.mark.usefixtures("at_once")
def test_a_broken_image_is_told_of_by_its_own_error_after_those_before_it(tmp_path: Path) -> None:
    write_base(tmp_path)
    sequence = load_sequence(str(tmp_path))
    assert isinstance(sequence, StoredSequence) and len(sequence) > 3
    broken = sorted((tmp_path / "rgb").iterdir())[3]
    broken.write_bytes(broken.read_bytes()[: broken.stat().st_size // 2])
    given = []
    slam = V3DSLAM(sequence.camera, config=NO_NETWORK)
    with (
        pytest.raises(InputError, match=rf"{broken.name}: is truncated"),
        closing(FramePrefetcher(iter(sequence), slam, ahead=True)) as percepts,
    ):
        for percept in percepts:
            slam.track(percept)
            given.append(percept.frame.index)
    assert given == [0, 1, 2]


def test_its_end_is_waited_for(demo: StoredSequence) -> None:
    slam = V3DSLAM(demo.camera, config=NO_NETWORK)
    second = PreprocessWorker(slam, demo)
    process = second._process
    assert process is not None and process.poll() is None
    second.close()
    assert process.returncode is not None
    second.submit(0, None)
    assert second.result() is None


@pytest.mark.parametrize(("cores", "ahead", "frames"), [(1, True, 100), (2, False, 100), (2, True, 3)])
def test_none_is_begun_that_would_not_pay(
    demo: StoredSequence, monkeypatch: pytest.MonkeyPatch, cores: int, ahead: bool, frames: int
) -> None:
    class Short(FrameIterator):
        @property
        def left(self) -> int:
            return max(frames - self.index, 0)

    def none(slam: V3DSLAM, sequence: StoredSequence) -> PreprocessWorker:
        raise AssertionError

    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "_WORTH", 4)
    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "_cores", lambda: cores)
    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "PreprocessWorker", none)
    slam = V3DSLAM(demo.camera, config=NO_NETWORK)
    with closing(FramePrefetcher(Short(demo, 0), slam, ahead=ahead)) as percepts:
        for percept in islice(percepts, 4):
            slam.track(percept)


def test_without_memory_to_share_and_without_processes(demo: StoredSequence, monkeypatch: pytest.MonkeyPatch) -> None:
    slam = V3DSLAM(demo.camera, config=NO_NETWORK)
    monkeypatch.setattr("v3d_torch.prefetch.preprocess_worker.new_arena", lambda values: None)
    with closing(PreprocessWorker(slam, demo)) as second:
        second.submit(1, slam.outlook())
        assert second.result() is not None
    monkeypatch.setattr("v3d_torch.prefetch.preprocess_worker.sys.executable", "/nowhere/python")
    with closing(PreprocessWorker(slam, demo)) as second:
        assert second._process is None
        second.submit(1, slam.outlook())
        assert second.result() is None
