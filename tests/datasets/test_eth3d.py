"""ETH3D SLAM benchmark: TUM layout, whose camera is that of calibration.txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.tiny_images import HEIGHT, WIDTH, colour_of, depth_of, save

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.eth3d import ETH3DSequence
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera

STAMPS = "5158.285592", "5158.322397"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "cables_1"
    for i, stamp in enumerate(STAMPS):
        save(root / "rgb" / f"{stamp}.png", colour_of(i))
        save(root / "depth" / f"{stamp}.png", depth_of(i))
    for kind in ("rgb", "depth"):
        (root / f"{kind}.txt").write_text("".join(f"{stamp} {kind}/{stamp}.png\n" for stamp in STAMPS))
    (root / "calibration.txt").write_text("726.21081542969 726.21081542969 16.2 11.4\n")
    (root / "groundtruth.txt").write_text("".join(f"{stamp} {i} 2 3 0 0 0 1\n" for i, stamp in enumerate(STAMPS)))
    return root


def test_eth3d_frames_and_camera_match_files(folder: Path) -> None:
    sequence = load_sequence(folder)
    assert isinstance(sequence, ETH3DSequence) and (sequence.name, len(sequence)) == ("cables_1", 2)
    focal = 726.21081542969
    assert sequence.camera == PinholeCamera(focal, focal, 16.2, 11.4, WIDTH, HEIGHT, depth_scale=5000.0, readout=0.0)
    np.testing.assert_allclose(sequence[1].depth[0], depth_of(1) / 5000, rtol=1e-6)
    assert sequence.groundtruth is not None
    assert sequence.groundtruth.T_wc[:, :3, 3].tolist() == [[0, 2, 3], [1, 2, 3]]


def test_camera_of_the_user_takes_precedence(folder: Path) -> None:
    (folder / "K.txt").write_text(f"30 31 15 11 1000 {WIDTH} {HEIGHT}\n")
    camera = load_sequence(folder).camera
    assert (camera.fx, camera.depth_scale, camera.readout) == (30.0, 1000.0, None)


@pytest.mark.parametrize("content", ["726.2 726.2\n", "calibrated on Monday", "30 31 15 11 1000 32 24"])
def test_folder_with_another_file_of_this_name_is_in_plain_tum_layout(folder: Path, content: str) -> None:
    (folder / "calibration.txt").write_text(content)
    with pytest.raises(InputError, match=r"has no camera parameters; add a camera\.yaml"):
        load_sequence(folder)
    (folder / "K.txt").write_text(f"30 31 15 11 1000 {WIDTH} {HEIGHT}\n")
    sequence = load_sequence(folder)
    assert type(sequence) is TUMSequence and sequence.camera.depth_scale == 1000.0
