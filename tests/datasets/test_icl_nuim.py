"""ICL-NUIM: timestamps from frame numbers, and conversion of camera and poses to a y axis that points down."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny_images import as_rgb, colour_of, depth_of, save

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.icl_nuim import ICLNUIMSequence
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import invert, se3_exp

POSES = "2 1 2 3 0.1 0.2 -0.3 0.9\n3 -1 0.5 2 0 0.5 0.1 0.8\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "living_room_traj0_frei_png"
    for i in range(1, 4):
        save(root / "rgb" / f"{i}.png", colour_of(i, 640, 480))
        save(root / "depth" / f"{i}.png", depth_of(i, 640, 480))
    (root / "associations.txt").write_text("".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(1, 4)))
    (root / "livingRoom0.gt.freiburg").write_text(POSES)
    return root


def test_icl_nuim_frames_match_files(folder: Path) -> None:
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, ICLNUIMSequence)
    assert sequence.name == folder.name
    assert sequence.stamps.tolist() == [1 / 30, 2 / 30, 3 / 30]
    assert np.array_equal(as_rgb(sequence[1].image), colour_of(2, 640, 480))
    np.testing.assert_allclose(sequence[1].depth[0], depth_of(2, 640, 480) / 5000, rtol=1e-6)
    assert sequence.groundtruth is not None
    assert sequence.groundtruth.stamps.tolist() == [2 / 30, 3 / 30]


def test_convention_y_points_down(folder: Path) -> None:
    """A point has the same pixel as with the published camera (fy = -480) and the published pose."""
    sequence = load_sequence(str(folder))
    assert sequence.groundtruth is not None
    camera = sequence.camera
    published = read_trajectory(folder / "livingRoom0.gt.freiburg").T_wc
    K = torch.tensor([[481.2, 0, 319.5], [0, -480.0, 239.5], [0, 0, 1]], dtype=torch.float64)
    in_front = torch.tensor([[0.3, -0.2, 2.0, 1.0], [-0.5, 0.4, 3.0, 1.0]], dtype=torch.float64)
    for T_wc, T_wc_published in zip(sequence.groundtruth.T_wc, published, strict=True):
        world = in_front @ T_wc_published.T
        expected = in_front[:, :3] @ K.T
        flipped = world * torch.tensor([1, -1, 1, 1])
        pixels = camera.project((flipped @ invert(T_wc).T)[:, :3])
        torch.testing.assert_close(pixels, expected[:, :2] / expected[:, 2:])
        assert torch.det(T_wc[:3, :3]) == pytest.approx(1.0)


def test_upward_motion_of_icl_nuim_is_negative_y(folder: Path) -> None:
    up = se3_exp(torch.tensor([0.0, 0.5, 0, 0, 0, 0], dtype=torch.float64))
    (folder / "livingRoom0.gt.freiburg").write_text(f"1 0 {up[1, 3].item()} 0 0 0 0 1\n")
    groundtruth = load_sequence(str(folder)).groundtruth
    assert groundtruth is not None and groundtruth.T_wc[0, 1, 3] == -0.5


def test_two_ground_truth_files_are_rejected(folder: Path) -> None:
    (folder / "livingRoom0n.gt.freiburg").write_text(POSES)
    with pytest.raises(
        InputError, match=r"several ground-truth files \(livingRoom0.gt.freiburg, livingRoom0n.gt.freiburg\)"
    ):
        load_sequence(str(folder))
