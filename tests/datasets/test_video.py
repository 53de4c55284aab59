"""A pair of videos: times from the files, 16 bits of depth without loss."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.tiny_images import CAMERA_YAML, HEIGHT, WIDTH, as_rgb, colour_of, depth_of
from numpy.typing import NDArray

from v3d_torch.datasets import SourceOptions, load_sequence
from v3d_torch.datasets.video import VideoSequence
from v3d_torch.errors import InputError

SIZE = (WIDTH, HEIGHT)


def write_colour(path: Path, fps: float, frames: int) -> None:
    """Without loss, so that pixels can be compared."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), fps, SIZE)
    assert writer.isOpened()
    for i in range(frames):
        writer.write(cv2.cvtColor(colour_of(i), cv2.COLOR_RGB2BGR))
    writer.release()


def write_depth(path: Path, fps: float, images: list[NDArray[np.uint16]]) -> None:
    deep = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), fps, SIZE, deep)
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Six colour frames at 30 a second and three depth frames at 15."""
    root = tmp_path / "take"
    root.mkdir()
    (root / "camera.yaml").write_text(CAMERA_YAML)
    write_colour(root / "rgb.avi", 30, 6)
    write_depth(root / "depth.mkv", 15, [depth_of(i) for i in range(3)])
    return root


def assert_frame(sequence: VideoSequence, index: int, colour: int, depth: int) -> None:
    frame = sequence[index]
    assert np.abs(as_rgb(frame.image).astype(int) - colour_of(colour)).max() <= 1
    np.testing.assert_allclose(frame.depth[0], depth_of(depth) / 1000, rtol=1e-6)


@pytest.mark.parametrize("given", ["", "rgb.avi"])
def test_frames_in_any_order(folder: Path, given: str, capfd: pytest.CaptureFixture[str]) -> None:
    sequence = load_sequence(str(folder / given))
    assert isinstance(sequence, VideoSequence)
    assert sequence.name == ("rgb" if given else "take")
    assert sequence.stamps.tolist() == pytest.approx([0, 2 / 30, 4 / 30], abs=1e-6)
    for index in (0, 1, 1, 2, 0):
        assert_frame(sequence, index, 2 * index, index)
    with pytest.raises(IndexError):
        sequence[3]
    assert capfd.readouterr().err == ""


def test_frames_a_second_of_the_user(folder: Path) -> None:
    sequence = load_sequence(str(folder), options=SourceOptions(fps=10))
    assert isinstance(sequence, VideoSequence)
    assert sequence.stamps.tolist() == pytest.approx([0, 0.1, 0.2])
    assert_frame(sequence, 2, 2, 2)


def test_several_takes_side_by_side(folder: Path) -> None:
    write_colour(folder / "second.mkv", 15, 2)
    write_depth(folder / "second_depth.mkv", 15, [depth_of(7), depth_of(8)])
    sequence = load_sequence(str(folder / "second.mkv"))
    assert isinstance(sequence, VideoSequence)
    assert_frame(sequence, 1, 1, 8)
    with pytest.raises(InputError, match=r"here are rgb\.avi, second\.mkv, depth\.mkv, second_depth\.mkv; name them"):
        load_sequence(str(folder))


def test_the_bar_is_told_of_every_frame(folder: Path) -> None:
    told: list[tuple[int, int | None]] = []
    load_sequence(str(folder), progress=lambda done, total: told.append((done, total)))
    assert told == [(i, 6) for i in range(1, 7)]


def test_depth_of_8_bits(folder: Path) -> None:
    (folder / "depth.mkv").unlink()
    write_colour(folder / "depth.mkv", 15, 3)
    with pytest.raises(InputError, match=r"depth\.mkv: has not 16 bits of grey"):
        load_sequence(str(folder))


@pytest.mark.parametrize("name", ["rgb.avi", "depth.mkv"])
def test_no_video(folder: Path, name: str) -> None:
    (folder / name).write_bytes(b"no video" * 100)
    with pytest.raises(InputError, match=rf"{name}: is no video that can be decoded"):
        load_sequence(str(folder))


def test_depth_is_missing(folder: Path) -> None:
    (folder / "depth.mkv").unlink()
    with pytest.raises(InputError, match=r"rgb\.avi: a colour and a depth video belong together, here are rgb\.avi;"):
        load_sequence(str(folder / "rgb.avi"))


def test_other_size_than_the_cameras(folder: Path) -> None:
    (folder / "camera.yaml").write_text(CAMERA_YAML.replace("width: 32", "width: 64"))
    with pytest.raises(InputError, match=r"rgb\.avi: has 32x24 pixels, but the camera has 64x24"):
        load_sequence(str(folder))[0]
