"""Data sets for training: samples, poses, missing truth, and loading in workers to the same bytes."""

from __future__ import annotations

import os
import pickle
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bags import DEPTH, INFO, KINDS, RGB, Kind, MessageFactory
from helpers.videos import write_video
from torch import Tensor
from torch.utils.data import ConcatDataset, DataLoader, Dataset

import v3d_torch as v3d
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.datasets.frame_datasets import Sample
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import RGBDFrame, Trajectory


@pytest.fixture(scope="module")
def sequence(moment: Path) -> RGBDSequence:
    return load_sequence(moment)


class TwistSequence:
    """Frames of a few pixels of a camera with a constant twist, whose true poses are at other times."""

    name = "twist"
    camera = PinholeCamera(fx=4.0, fy=4.0, cx=1.5, cy=1.0, width=4, height=3)
    twist = torch.tensor([0.3, -0.2, 0.1, 0.5, 0.4, -0.6], dtype=torch.float64)

    def __init__(self, frames: int = 12, truth: tuple[float, ...] | None = None) -> None:
        self.stamps = 2.0 + torch.arange(frames, dtype=torch.float64) / 30
        known = torch.tensor(truth, dtype=torch.float64) if truth is not None else 1.99 + torch.arange(30.0) / 21
        self.groundtruth: Trajectory | None = Trajectory(known, self.poses(known))

    def poses(self, stamps: Tensor) -> Tensor:
        return se3_exp(stamps.to(torch.float64)[:, None] * self.twist)

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[RGBDFrame]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, index: int) -> RGBDFrame:
        image = torch.full((3, 3, 4), index, dtype=torch.uint8)
        return RGBDFrame(index, float(self.stamps[index]), image, torch.full((1, 3, 4), 1.0 + index))


def test_frame_has_images_camera_pose_and_mask(sequence: RGBDSequence) -> None:
    dataset = v3d.FrameDataset(sequence)
    assert len(dataset) == 6 and sequence.groundtruth is not None
    for index, sample in enumerate(dataset):
        frame = sequence[index]
        assert list(sample) == ["index", "stamp", "image", "depth", "K", "T_wc", "motion_mask"]
        assert sample["index"] == index and sample["stamp"].dtype == torch.float64
        assert sample["stamp"] == frame.stamp and sample["K"].equal(sequence.camera.K)
        assert sample["image"].equal(frame.image) and sample["depth"].equal(frame.depth)
        assert sample["T_wc"].equal(sequence.groundtruth.T_wc[index])  # the stamps are the same
        assert sample["motion_mask"].equal(sequence.motion_mask(index))  # type: ignore[attr-defined]
    with pytest.raises(IndexError):
        dataset[6]
    with pytest.raises(InputError, match=r"got slice\(0, 2, None\); .* torch\.utils\.data\.Subset$"):
        dataset[0:2]  # type: ignore[index]


@pytest.mark.parametrize("interval", [1, 3, 5])
def test_pair_has_the_pose_of_the_earlier_camera_in_the_later(sequence: RGBDSequence, interval: int) -> None:
    dataset, frames = v3d.PairDataset(sequence, interval), v3d.FrameDataset(sequence)
    assert len(dataset) == 6 - interval
    for item, pair in enumerate(dataset):
        first, second = frames[item], frames[item + interval]
        suffixed = {f"{key}{n}" for key in first.keys() - {"K", "T_wc"} for n in (0, 1)}
        assert pair.keys() == suffixed | {"K", "T_10"}
        assert pair["image0"].equal(first["image"]) and pair["motion_mask1"].equal(second["motion_mask"])
        torch.testing.assert_close(second["T_wc"] @ pair["T_10"], first["T_wc"], rtol=0, atol=1e-12)


def test_points_of_a_pair_agree_by_its_pose(sequence: RGBDSequence) -> None:
    """Static pixels of frame 0, moved by T_10, have the depth that frame 1 measures."""
    pair = v3d.PairDataset(sequence, interval=5)[0]
    camera = sequence.camera
    v, u = ((pair["depth0"][0] > 0) & (pair["motion_mask0"] == 0)).nonzero(as_tuple=True)
    points = camera.back_project(torch.stack([u, v], dim=1).double(), pair["depth0"][0, v, u].double())
    medians = []
    for T_10 in (pair["T_10"], torch.eye(4, dtype=torch.float64), torch.linalg.inv(pair["T_10"])):
        moved = points @ T_10[:3, :3].T + T_10[:3, 3]
        uv = camera.project(moved).round().long()
        is_inside = ((uv >= 0) & (uv < torch.tensor([640, 480]))).all(dim=1)
        measured = pair["depth1"][0, uv[is_inside, 1], uv[is_inside, 0]].double()
        medians.append((measured - moved[is_inside, 2]).abs()[measured > 0].median())
    assert 3 * medians[0] < medians[1] < medians[2]


def test_clips_are_consecutive_frames(sequence: RGBDSequence) -> None:
    dataset = v3d.ClipDataset(sequence, frames_per_clip=3, step_between_clips=2)
    assert [clip["index"].tolist() for clip in dataset] == [[0, 1, 2], [2, 3, 4]]
    shapes = {key: tuple(value.shape) for key, value in dataset[0].items()}
    assert shapes == {
        **{"index": (3,), "stamp": (3,), "image": (3, 3, 480, 640), "depth": (3, 1, 480, 640)},
        **{"K": (3, 3), "T_wc": (3, 4, 4), "motion_mask": (3, 480, 640)},
    }
    assert dataset[1]["depth"][2].equal(sequence[4].depth)


def test_poses_between_true_poses_are_on_the_geodesic() -> None:
    sequence = TwistSequence()
    found = torch.stack([sample["T_wc"] for sample in v3d.FrameDataset(sequence)])
    torch.testing.assert_close(found, sequence.poses(sequence.stamps), rtol=0, atol=1e-12)
    T_10 = v3d.PairDataset(sequence, interval=2)[4]["T_10"]
    torch.testing.assert_close(T_10, se3_exp(-sequence.twist * 2 / 30), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("truth", "frames", "pairs", "clips"),
    [
        ((1.9, 1.95, 2.05, 2.15, 2.25, 2.35, 2.45), list(range(12)), list(range(10)), list(range(9))),
        ((2.05, 2.15), [2, 3, 4], [2], []),  # before and after the truth
        ((1.95, 2.05, 2.3, 2.4), [0, 1, 9, 10, 11], [9], []),  # a gap of 0.25 s
        ((1.0, 2.0, 3.0), [0], [], []),  # at a true pose, the others far from any
        ((2.0,), [0], [], []),
    ],
)
def test_frames_without_a_true_pose_are_left_out(
    truth: tuple[float, ...], frames: list[int], pairs: list[int], clips: list[int]
) -> None:
    sequence = TwistSequence(truth=truth)
    dataset = v3d.FrameDataset(sequence)
    assert dataset.indices == frames and all(sample["T_wc"].isfinite().all() for sample in dataset)
    for make, expected in (
        (partial(v3d.PairDataset, interval=2), pairs),
        (partial(v3d.ClipDataset, frames_per_clip=4), clips),
    ):
        if expected:
            assert make(sequence).indices == expected
        else:
            with pytest.raises(
                InputError, match=rf"^twist: has no frames for a sample .* {len(frames)} have a true pose"
            ):
                make(sequence)


def test_without_ground_truth_and_masks_there_are_no_keys_for_them(moment: Path, tmp_path: Path) -> None:
    shutil.copytree(moment, tmp_path / "plain")
    (tmp_path / "plain" / "groundtruth.txt").unlink()
    shutil.rmtree(tmp_path / "plain" / "masks")
    sequence = load_sequence(tmp_path / "plain")
    assert list(v3d.FrameDataset(sequence)[0]) == ["index", "stamp", "image", "depth", "K"]
    assert "T_10" not in v3d.PairDataset(sequence)[0] and "T_wc" not in v3d.ClipDataset(sequence, 2)[0]


@pytest.mark.parametrize("missing", [0, 2])
def test_missing_mask_excludes_the_whole_frame(moment: Path, tmp_path: Path, missing: int) -> None:
    shutil.copytree(moment, tmp_path / "part")
    sorted((tmp_path / "part" / "masks").iterdir())[missing].unlink()
    masks = v3d.ClipDataset(load_sequence(tmp_path / "part"), 6)[0]["motion_mask"]
    assert [bool((mask == 255).all()) for mask in masks] == [frame == missing for frame in range(6)]


def test_change_of_a_sample_in_place_does_not_reach_the_next(sequence: RGBDSequence) -> None:
    def spoil(sample: Sample) -> Sample:
        return {key: value.zero_() for key, value in sample.items()}

    spoiled, clean = v3d.FrameDataset(sequence, transform=spoil), v3d.FrameDataset(sequence)
    assert not any(value.any() for value in spoiled[1].values())
    assert clean[1]["K"][2, 2] == 1 and clean[1]["T_wc"][3, 3] == 1 and sequence.camera.K[2, 2] == 1
    spoiled.transform = None
    assert spoiled[1]["T_wc"].equal(clean[1]["T_wc"])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda s: v3d.PairDataset(s, interval=0), "interval is 0; give a positive number of frames"),
        (
            lambda s: v3d.PairDataset(s, interval=6),
            "has no frames for a sample among its 6 frames, of which 6 have a true",
        ),
        (
            lambda s: v3d.PairDataset(s, interval=2.0),
            "interval is 2.0; give a positive number of frames, as an integer",
        ),
        (
            lambda s: v3d.PairDataset(s, interval="2"),
            "interval is '2'; give a positive number of frames, as an integer",
        ),
        (lambda s: v3d.ClipDataset(s, 0), "frames_per_clip is 0; give"),
        (lambda s: v3d.ClipDataset(s, 2.5), "frames_per_clip is 2.5; give"),
        (lambda s: v3d.ClipDataset(s, 2, None), "step_between_clips is None; give"),
        (lambda s: v3d.ClipDataset(s, 900), "use fewer frames, or a smaller interval"),
        (lambda s: v3d.ClipDataset(s, 2, -1), "step_between_clips is -1; give"),
        (
            lambda s: v3d.FrameDataset("demo"),
            "needs a sequence with stored frames, got a str; give one, such as load_seq",
        ),
    ],
)
def test_impossible_samples_are_one_sentence(make: object, message: str, sequence: RGBDSequence) -> None:
    with pytest.raises(InputError, match=message) as caught:
        make(sequence)  # type: ignore[operator]
    assert "\n" not in str(caught.value)


def test_ground_truth_of_another_recording_is_an_error(moment: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(moment, tmp_path / "moment")
    (folder / "groundtruth.txt").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    message = "^moment: none of its 6 frames has a true pose; check that stamps and ground truth belong to the same rec"
    with pytest.raises(InputError, match=message):
        v3d.FrameDataset(load_sequence(folder))


def batches(dataset: Dataset[Sample], workers: int, start: str | None = None) -> list[Sample]:
    loader = DataLoader(
        dataset,
        batch_size=2,
        shuffle=True,
        num_workers=workers,
        multiprocessing_context=start,
        generator=torch.Generator().manual_seed(3),
    )
    return list(loader)


def assert_same(first: list[Sample], second: list[Sample]) -> None:
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert one.keys() == other.keys()
        assert all(value.dtype == other[key].dtype and value.equal(other[key]) for key, value in one.items())


@pytest.mark.parametrize(("start", "workers"), [("fork", 2), ("spawn", 1)])
@pytest.mark.skipif(os.name == "nt", reason="Windows cannot fork")
def test_loader_gives_the_same_batches_in_workers(sequence: RGBDSequence, start: str, workers: int) -> None:
    dataset = v3d.PairDataset(sequence, interval=2)
    expected = batches(dataset, 0)
    assert [len(batch["T_10"]) for batch in expected] == [2, 2]
    assert expected[0]["image0"].shape == (2, 3, 480, 640) and expected[0]["stamp1"].shape == (2,)
    assert_same(expected, batches(dataset, workers, start))
    assert_same(expected, batches(dataset, 0))


def test_data_sets_of_several_sequences_are_joined(sequence: RGBDSequence) -> None:
    both = ConcatDataset([v3d.PairDataset(sequence, 1), v3d.PairDataset(sequence, 3)])
    (batch,) = DataLoader(both, batch_size=8)
    assert (batch["index1"] - batch["index0"]).tolist() == [1, 1, 1, 1, 1, 3, 3, 3]


def write_videos(folder: Path) -> Path:
    folder.mkdir()
    write_video(folder / "rgb.avi", 15, [np.full((48, 64, 3), 20 * i, np.uint8) for i in range(6)])
    write_video(folder / "depth.mkv", 15, [np.full((48, 64), 1000 + i, np.uint16) for i in range(6)])
    (folder / "camera.yaml").write_text(
        "{fx: 60, fy: 60, cx: 31.5, cy: 23.5, width: 64, height: 48, depth_scale: 1000}\n"
    )
    return folder


def write_bag(path: Path, kind: Kind) -> Path:
    factory = MessageFactory(kind)
    K = [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
    messages = [(INFO, 1.0, factory.info(64, 48, K, [0.0] * 5, [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]))]
    for i in range(6):
        colour, depth = np.full((48, 64, 3), 20 * i, np.uint8), np.full((48, 64), 1000 + i, np.uint16)
        messages.append((RGB, 1 + i / 30, factory.image(1 + i / 30, "rgb8", colour)))
        messages.append((DEPTH, 1 + i / 30, factory.image(1 + i / 30, "16UC1", depth)))
    return factory.write(path, messages)


@pytest.mark.parametrize("kind", ["video", *KINDS])
@pytest.mark.skipif(os.name == "nt", reason="Windows cannot fork")
def test_streams_that_are_read_in_order_are_pickled_and_forked(kind: Kind, tmp_path: Path) -> None:
    """Their open files have a position, which processes must not share."""
    path = write_videos(tmp_path / "video") if kind == "video" else write_bag(tmp_path / "bag", kind)
    dataset = v3d.FrameDataset(load_sequence(path))
    expected = batches(dataset, 0)
    order = torch.cat([batch["index"] for batch in expected])
    assert torch.cat([batch["depth"] for batch in expected])[:, 0, 0, 0].sub(1).mul(1000).round().equal(order.float())
    dataset[2]  # the files of this process are open, at a position
    assert_same(expected, batches(pickle.loads(pickle.dumps(dataset)), 0))  # noqa: S301
    assert_same(expected, batches(dataset, 2, "fork"))
    assert dataset[3]["index"] == 3 and dataset[3]["depth"][0, 0, 0].sub(1.003).abs() < 1e-6
