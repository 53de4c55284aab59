"""Writer of folders in TUM layout."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny_images import HEIGHT, WIDTH, as_rgb, colour_of

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.errors import OutputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame


def test_failure_of_source_keeps_saved_frames(tmp_path: Path) -> None:
    camera = PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT, depth_scale=1000)
    frame = RGBDFrame(0, 12.5, torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8), torch.ones(1, HEIGHT, WIDTH))
    with pytest.raises(RuntimeError, match="broke"), TUMWriter(tmp_path / "out", camera) as writer:
        writer.add(frame)
        raise RuntimeError("broke")
    assert load_sequence(str(tmp_path / "out")).stamps.tolist() == [12.5]


def test_frames_are_listed_at_once(tmp_path: Path) -> None:
    """A process that is killed does not leave the context."""
    image, depth = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8), torch.ones(1, HEIGHT, WIDTH)
    writer = TUMWriter(tmp_path / "out", PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT, depth_scale=1000))
    for count in (1, 2):
        writer.add(RGBDFrame(count, count, image, depth, depth_delay=0.25))
        assert len(load_sequence(str(tmp_path / "out"))) == len(writer) == count
        last = f"{count + 0.25:.6f}"
        assert (tmp_path / "out" / "depth.txt").read_text().splitlines()[-1] == f"{last} depth/{last}.png"


def test_depth_images_with_the_same_stamp_are_kept(tmp_path: Path) -> None:
    image, depth = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8), torch.ones(1, HEIGHT, WIDTH)
    with TUMWriter(tmp_path / "out", PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT, depth_scale=1000)) as writer:
        writer.add(RGBDFrame(0, 1.0, image, 2 * depth, depth_delay=0.01))
        writer.add(RGBDFrame(1, 1.01, image, 3 * depth))
    first, second = load_sequence(str(tmp_path / "out"))
    assert torch.equal(first.depth, 2 * depth) and torch.equal(second.depth, 3 * depth)
    assert (first.depth_delay, second.depth_delay) == (pytest.approx(0.01), 0)


def test_source_without_frames_leaves_the_folder_empty(tmp_path: Path) -> None:
    with TUMWriter(tmp_path / "out", PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT)):
        pass
    assert not list((tmp_path / "out").iterdir())


def test_depth_is_exact_and_out_of_range_is_zero(tmp_path: Path) -> None:
    camera = PinholeCamera(1, 2, 3, 4, 256, 256, depth_scale=1000)
    units = torch.arange(256 * 256, dtype=torch.float32).reshape(1, 256, 256)
    image = torch.from_numpy(colour_of(0, 256, 256)).permute(2, 0, 1)
    for stamp, depth in ((1.0, units / 1000), (2.0, units / 1000 + 30)):
        with TUMWriter(tmp_path / str(stamp), camera) as writer:
            writer.add(RGBDFrame(0, stamp, image, depth))
    frame = load_sequence(str(tmp_path / "1.0"))[0]
    assert np.array_equal(as_rgb(frame.image), colour_of(0, 256, 256))
    assert torch.equal(frame.depth, torch.where(units < 65535, units / 1000, 0))
    far = load_sequence(str(tmp_path / "2.0"))[0].depth
    assert torch.equal(far == 0, units >= 35535)


def test_depth_out_of_range_is_counted_in_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    image, depth = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8), torch.full((1, HEIGHT, WIDTH), 13.0)
    far = depth.clone()
    far[0, :2, 0] = 13.2
    for name, images in (("near", [depth]), ("far", [depth, far, far])):
        with TUMWriter(tmp_path / name, PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT)) as writer:
            for index, metres in enumerate(images):
                writer.add(RGBDFrame(index, 12.5 + index, image, metres))
    (record,) = caplog.records
    assert re.search(r"far: 4 depth values beyond 13\.11 m were saved as 0; a camera with a", record.getMessage())


def test_gravity_of_the_first_frame_is_kept(tmp_path: Path) -> None:
    camera = PinholeCamera(1, 2, 3, 4, WIDTH, HEIGHT, depth_scale=1000)
    down = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    image, depth = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8), torch.ones(1, HEIGHT, WIDTH)
    frames = [RGBDFrame(index, 12.5 + index, image, depth, gravity=down) for index in range(2)]
    with TUMWriter(tmp_path / "out", camera) as writer:
        for frame in frames:
            writer.add(frame)
    first, second = load_sequence(str(tmp_path / "out"))
    assert first.gravity is not None and second.gravity is None
    torch.testing.assert_close(first.gravity, down)


def test_file_in_place_of_folder_is_error(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    for folder in (tmp_path / "taken", tmp_path / "taken" / "below"):
        with pytest.raises(OutputError, match="taken"):
            TUMWriter(folder, PinholeCamera(1, 2, 3, 4))
