"""Preprocessing in a second process: identical results, and no frame is lost if the process fails."""

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


def are_identical(a: object, b: object) -> bool:
    """Compare two nested values to the bit."""
    if isinstance(a, Tensor):
        return isinstance(b, Tensor) and a.dtype == b.dtype and torch.equal(a.nan_to_num(), b.nan_to_num())
    if hasattr(a, "__dataclass_fields__"):
        names = [field.name for field in fields(a)]  # type: ignore[arg-type]
        return all(are_identical(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(are_identical(a[key], b[key]) for key in a)
    if isinstance(a, tuple):
        return isinstance(b, tuple) and all(map(are_identical, a, b))
    return a == b


def without_times(preprocessed: PreprocessedFrame) -> PreprocessedFrame:
    return replace(preprocessed, seconds={})


def test_worker_gives_the_same_results_as_this_process(demo: StoredSequence) -> None:
    """With the network and the state of its upright segmentation."""
    local, slam = V3DSLAM(demo.camera, config=SMALL), V3DSLAM(demo.camera, config=SMALL)
    prediction = local.predictions[0]
    with closing(PreprocessWorker(slam, demo)) as worker:
        worker.submit(0, prediction)
        for index in range(3):
            worker.submit(index + 1, prediction)
            expected = local.preprocess(demo[index], prediction)
            preprocessed = worker.result()
            assert preprocessed is not None
            assert are_identical(without_times(preprocessed), without_times(expected))
            assert are_identical(segmenter_state_of(slam.segment), expected.segmenter_state)
            assert set(preprocessed.times) == {"read", "segmentation", "depth", "features"}
            assert preprocessed.frame.camera is demo.camera


def test_worker_of_a_checked_system_gives_the_same_results(demo: StoredSequence) -> None:
    slam = CheckedSLAM(demo.camera, config=NO_NETWORK)
    with closing(PreprocessWorker(slam, demo)) as worker:
        worker.submit(0, slam.predictions[0])
        preprocessed = worker.result()
    expected = slam.preprocess(demo[0], slam.predictions[0])
    assert preprocessed is not None and are_identical(without_times(preprocessed), without_times(expected))


class ShortIterator(FrameIterator):
    """Iterator over the first frames of a sequence.

    Args:
        sequence: Sequence of the frames.
        count: Number of frames.
    """

    def __init__(self, sequence: StoredSequence, count: int) -> None:
        super().__init__(sequence, 0)
        self._count = count

    @property
    def remaining(self) -> int:
        return max(self._count - self.index, 0)


@pytest.fixture
def worker_for_any_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start a second process for any number of frames."""
    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "_MIN_FRAMES_FOR_WORKER", 1)
    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "_available_cores", lambda: 2)


def track_all(
    config: Config, frames: Iterator[RGBDFrame], sequence: StoredSequence
) -> tuple[V3DSLAM, list[PreprocessedFrame]]:
    slam, tracked = V3DSLAM(sequence.camera, config=config), []
    with closing(FramePrefetcher(frames, slam, ahead=True)) as prefetcher:
        for preprocessed in prefetcher:
            slam.track(preprocessed)
            tracked.append(preprocessed)
    return slam, tracked


@pytest.mark.usefixtures("worker_for_any_length")
def test_trajectory_with_a_worker_equals_that_without(demo: StoredSequence) -> None:
    slam, tracked = track_all(SMALL, ShortIterator(demo, 6), demo)
    plain, _ = track_all(SMALL, (demo[index] for index in range(6)), demo)
    assert [preprocessed.frame.index for preprocessed in tracked] == list(range(6))
    assert torch.equal(slam.poses.trajectory().T_wc, plain.poses.trajectory().T_wc)
    assert are_identical(segmenter_state_of(slam.segment), segmenter_state_of(plain.segment))


@pytest.mark.usefixtures("worker_for_any_length")
def test_run_continues_after_the_worker_is_killed(demo: StoredSequence) -> None:
    slam, tracked = V3DSLAM(demo.camera, config=NO_NETWORK), []
    with closing(FramePrefetcher(iter(demo), slam, ahead=True)) as prefetcher:
        worker = prefetcher._worker
        assert worker is not None and worker._process is not None
        for preprocessed in prefetcher:
            slam.track(preprocessed)
            tracked.append(preprocessed.frame.index)
            if len(tracked) == 3:
                assert worker._process.poll() is None and worker.is_alive
                worker._process.kill()
            if len(tracked) == 7:
                assert not worker.is_alive
                break
    assert tracked == list(range(7))


@pytest.mark.usefixtures("worker_for_any_length")
def test_segmenter_that_cannot_be_pickled_runs_in_this_process(demo: StoredSequence) -> None:
    def segment(frame: RGBDFrame) -> Instances:
        return NoSegmentation()(frame)

    slam = V3DSLAM(demo.camera, segment, NO_NETWORK)
    with closing(PreprocessWorker(slam, demo)) as worker:
        assert not worker.is_alive
        worker.submit(0, None)
        assert worker.result() is None
    with closing(FramePrefetcher(iter(demo), slam, ahead=True)) as prefetcher:
        assert prefetcher._worker is None and prefetcher._thread is not None


@pytest.mark.usefixtures("worker_for_any_length")
def test_truncated_image_raises_its_own_error_after_the_frames_before_it(tmp_path: Path) -> None:
    write_base(tmp_path)
    sequence = load_sequence(str(tmp_path))
    assert isinstance(sequence, StoredSequence) and len(sequence) > 3
    broken = sorted((tmp_path / "rgb").iterdir())[3]
    broken.write_bytes(broken.read_bytes()[: broken.stat().st_size // 2])
    tracked = []
    slam = V3DSLAM(sequence.camera, config=NO_NETWORK)
    with (
        pytest.raises(InputError, match=rf"{broken.name}: is truncated"),
        closing(FramePrefetcher(iter(sequence), slam, ahead=True)) as prefetcher,
    ):
        for preprocessed in prefetcher:
            slam.track(preprocessed)
            tracked.append(preprocessed.frame.index)
    assert tracked == [0, 1, 2]


def test_close_ends_the_process(demo: StoredSequence) -> None:
    slam = V3DSLAM(demo.camera, config=NO_NETWORK)
    worker = PreprocessWorker(slam, demo)
    process = worker._process
    assert process is not None and process.poll() is None
    worker.close()
    assert process.returncode is not None
    worker.submit(0, None)
    assert worker.result() is None


@pytest.mark.parametrize(("cores", "ahead", "frames"), [(1, True, 100), (2, False, 100), (2, True, 3)])
def test_no_worker_is_started_without_benefit(
    demo: StoredSequence, monkeypatch: pytest.MonkeyPatch, cores: int, ahead: bool, frames: int
) -> None:
    def fail(slam: V3DSLAM, sequence: StoredSequence) -> PreprocessWorker:
        raise AssertionError

    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "_MIN_FRAMES_FOR_WORKER", 4)
    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "_available_cores", lambda: cores)
    monkeypatch.setattr(v3d_torch.prefetch.frame_prefetcher, "PreprocessWorker", fail)
    slam = V3DSLAM(demo.camera, config=NO_NETWORK)
    with closing(FramePrefetcher(ShortIterator(demo, frames), slam, ahead=ahead)) as prefetcher:
        for preprocessed in islice(prefetcher, 4):
            slam.track(preprocessed)


def test_worker_without_shared_memory_works_and_without_process_fails(
    demo: StoredSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = V3DSLAM(demo.camera, config=NO_NETWORK)
    monkeypatch.setattr("v3d_torch.prefetch.preprocess_worker.new_shared_memory", lambda values: None)
    with closing(PreprocessWorker(slam, demo)) as worker:
        worker.submit(1, slam.predictions[0])
        assert worker.result() is not None
    monkeypatch.setattr("v3d_torch.prefetch.preprocess_worker.sys.executable", "/nowhere/python")
    with closing(PreprocessWorker(slam, demo)) as worker:
        assert worker._process is None
        worker.submit(1, slam.predictions[0])
        assert worker.result() is None
