"""Extents of the sequences of the benchmark: parts, other recordings and other ground truths are recognised."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from v3d_torch.datasets import PAPER_SEQUENCES, short_name
from v3d_torch.datasets.lists import read_image_list
from v3d_torch.datasets.tum_extents import EXTENTS, describe_difference, describe_estimate_difference
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.evaluation.summary import format_markdown
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame, Trajectory


@dataclass(frozen=True)
class Listed:
    """Sequence of which only the lists are known."""

    stamps: Tensor
    groundtruth: Trajectory | None = None
    name: str = "fr3/w/xyz"
    camera: PinholeCamera | None = None

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> None:
        raise NotImplementedError

    def __getitem__(self, index: int) -> RGBDFrame:
        raise NotImplementedError


def whole(name: str = "fr3/w/xyz") -> Listed:
    """Sequence with evenly spaced frames and true poses, of the extent of a sequence of the benchmark."""
    frames, poses, length = EXTENTS[name]
    assert poses is not None and length is not None
    T_wc = torch.eye(4, dtype=torch.float64).repeat(poses.number, 1, 1)
    T_wc[:, 0, 3] = torch.linspace(0, length, poses.number, dtype=torch.float64)
    truth = Trajectory(torch.linspace(poses.first, poses.last, poses.number, dtype=torch.float64), T_wc)
    return Listed(torch.linspace(frames.first, frames.last, frames.number, dtype=torch.float64), truth, name)


def test_extents_are_known_for_all_sequences_of_the_paper() -> None:
    assert {short_name(name) for name in PAPER_SEQUENCES} | {"fr1/rpy"} == EXTENTS.keys()


@pytest.mark.parametrize("name", EXTENTS)
def test_extents_equal_the_lists_of_the_benchmark(name: str, v3d_data: Path) -> None:
    camera, *rest = name.split("/")
    words = {"s": "sitting", "w": "walking", "half": "halfsphere"}
    tail = "_".join(words.get(word, word) for word in rest)
    if camera == "fr1":
        lists, truths = v3d_data / "fr1_rpy" / "associations.txt", v3d_data / "fr1_rpy" / "groundtruth.txt"
    else:
        lists = v3d_data / "tum_associations" / f"fr3_{tail}.txt"
        truths = v3d_data / "tum_groundtruth" / f"rgbd_dataset_freiburg3_{tail}.txt"
    if not lists.is_file():
        pytest.skip(f"no real data: {lists} is missing")
    stamps = torch.tensor([stamp for stamp, _ in read_image_list(lists)], dtype=torch.float64)
    truth = read_trajectory(truths) if EXTENTS[name].poses is not None else None
    extent = EXTENTS[name]
    assert (len(stamps), stamps[0].item(), stamps[-1].item()) == extent.frames
    if truth is not None:
        assert extent.poses == (len(truth), truth.stamps[0].item(), truth.stamps[-1].item())
    assert describe_difference(Listed(stamps, truth, name)) is None


def test_whole_sequence_has_no_difference() -> None:
    assert describe_difference(whole()) is None
    assert describe_difference(replace(whole(), groundtruth=None)) is None
    lacking = whole().stamps[torch.arange(827) % 150 != 7]  # another rule of association
    assert describe_difference(replace(whole(), stamps=lacking)) is None


def test_unknown_name_has_no_difference() -> None:
    assert describe_difference(replace(whole(), name="my_desk", stamps=torch.arange(3.0))) is None


@pytest.mark.parametrize(
    ("selected", "difference"),
    [
        (slice(0, 60), "part: 60 of 827 frames"),
        (slice(300, None), "part: 527 of 827 frames"),
        (slice(None, None, 2), "part: 414 of 827 frames"),
        (slice(0, -20), "part: 807 of 827 frames"),
    ],
)
def test_part_of_a_sequence_is_recognised(selected: slice, difference: str) -> None:
    assert describe_difference(replace(whole(), stamps=whole().stamps[selected])) == difference


def test_part_is_marked_in_the_row_with_the_results_of_the_paper() -> None:
    """The table compares a sequence with the paper if its name contains one of the paper."""
    name = "fr3_walking_xyz_first300"
    difference = describe_difference(replace(whole(), name=name, stamps=whole().stamps[:300]))
    text = format_markdown([Outcome(name, "full", 0, {"ate": {"rmse": 0.001}, "difference": difference})])
    (row,) = (line for line in text.splitlines() if name in line)
    assert row.startswith(f"| {name} (part: 300 of 827 frames) | 0.0010 |") and "**" not in row
    assert "V3D-SLAM (paper)" in text


@pytest.mark.parametrize(
    ("stamps", "count"),
    [
        (torch.arange(827) / 30, 827),
        (torch.linspace(1341846313.6, 1341846342.4, 1200, dtype=torch.float64), 1200),
        (whole("fr3/w/rpy").stamps, 866),
    ],
)
def test_another_recording_is_recognised(stamps: Tensor, count: int) -> None:
    assert describe_difference(replace(whole(), stamps=stamps)) == f"another recording: {count} frames, not 827"


def test_other_ground_truth_is_recognised() -> None:
    sequence = whole()
    truth = sequence.groundtruth
    assert truth is not None
    sparse = Trajectory(truth.stamps[::4], truth.T_wc[::4])
    millimetres = truth.T_wc.clone()
    millimetres[:, :3, 3] *= 1000
    for other, found in ((sparse, "721 poses over 6.61 m"), (Trajectory(truth.stamps, millimetres), "over 6618.10 m")):
        difference = describe_difference(replace(sequence, groundtruth=other))
        assert difference is not None and difference.startswith("other ground truth: ") and found in difference
        assert difference.endswith("not 2884 over 6.62 m")


def estimate_at(stamps: Tensor) -> Trajectory:
    """Estimate at the origin."""
    return Trajectory(stamps, torch.eye(4, dtype=torch.float64).repeat(len(stamps), 1, 1))


@pytest.mark.parametrize(
    ("selected", "difference"),
    [
        (slice(None), None),
        (slice(0, 60), "part: 60 of 827 frames"),
        (slice(None, None, 2), "part: 414 of 827 frames"),
    ],
)
def test_part_is_recognised_from_an_estimate(selected: slice, difference: str | None) -> None:
    sequence = whole()
    truth = sequence.groundtruth
    assert truth is not None
    estimate = estimate_at(sequence.stamps[selected])
    assert describe_estimate_difference("fr3_w_xyz", estimate, truth) == difference
    assert describe_estimate_difference("my_desk", estimate, truth) is None
    if difference is None:
        cut = describe_estimate_difference("fr3/w/xyz", estimate, Trajectory(truth.stamps[:300], truth.T_wc[:300]))
        assert cut is not None and cut.startswith("other ground truth: 300 poses")


def test_estimate_with_colour_images_without_depth_is_no_other_recording() -> None:
    """All colour images of fr3/w/xyz are 859, of which 827 have depth."""
    first, last = EXTENTS["fr3/w/xyz"].frames[1:]
    truth = whole().groundtruth
    assert truth is not None
    estimate = estimate_at(torch.linspace(first, last, 859, dtype=torch.float64))
    assert describe_estimate_difference("fr3/w/xyz", estimate, truth) is None
