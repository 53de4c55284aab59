"""Pairs of a colour video and a 16-bit depth video: timestamps, pairing and invalid files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from helpers.tiny_images import CAMERA_YAML, as_rgb, colour_of, depth_of
from helpers.videos import write_video

from v3d_torch.datasets import SourceOptions, load_sequence
from v3d_torch.datasets.video import VideoSequence, _open_frames
from v3d_torch.errors import InputError


def write_colour(path: Path, fps: float, frames: int) -> None:
    write_video(path, fps, [colour_of(i) for i in range(frames)])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder with six colour frames at 30 Hz and three depth frames at 15 Hz."""
    root = tmp_path / "take"
    root.mkdir()
    (root / "camera.yaml").write_text(CAMERA_YAML)
    write_colour(root / "rgb.avi", 30, 6)
    write_video(root / "depth.mkv", 15, [depth_of(i) for i in range(3)])
    return root


def assert_frame(sequence: VideoSequence, index: int, colour: int, depth: int) -> None:
    frame = sequence[index]
    assert np.abs(as_rgb(frame.image).astype(int) - colour_of(colour)).max() <= 1
    np.testing.assert_allclose(frame.depth[0], depth_of(depth) / 1000, rtol=1e-6)


@pytest.mark.parametrize("given", ["", "rgb.avi"])
def test_frames_can_be_read_in_any_order(folder: Path, given: str, capfd: pytest.CaptureFixture[str]) -> None:
    sequence = load_sequence(str(folder / given))
    assert isinstance(sequence, VideoSequence)
    assert sequence.name == ("rgb" if given else "take")
    assert sequence.stamps.tolist() == pytest.approx([0, 2 / 30, 4 / 30], abs=1e-6)
    words = "3 of 6 colour images have no depth image within 20 ms and are left out (the last at 0.166667 s)"
    assert sequence.notes == [words]
    for index in (0, 1, 1, 2, 0):
        assert_frame(sequence, index, 2 * index, index)
    with pytest.raises(IndexError):
        sequence[3]
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are counted in /proc")
def test_dot_in_the_name_of_a_folder_is_no_suffix(folder: Path) -> None:
    assert load_sequence(str(folder.rename(folder.with_name("run_v1.2")))).name == "run_v1.2"


def test_reading_starts_no_threads_that_would_block_a_forked_process(tmp_path: Path) -> None:
    write_video(tmp_path / "large.avi", 30, [np.zeros((480, 640, 3), np.uint8)])
    before = len(list(Path("/proc/self/task").iterdir()))
    capture = next(iter(_open_frames(tmp_path / "large.avi")))
    capture.retrieve()
    assert len(list(Path("/proc/self/task").iterdir())) == before


def test_fps_of_the_user_sets_the_timestamps(folder: Path) -> None:
    sequence = load_sequence(str(folder), options=SourceOptions(fps=10))
    assert isinstance(sequence, VideoSequence)
    assert sequence.stamps.tolist() == pytest.approx([0, 0.1, 0.2])
    assert_frame(sequence, 2, 2, 2)


def test_depth_delay_is_the_difference_of_the_timestamps(folder: Path) -> None:
    write_video(folder / "depth.mkv", 25, [depth_of(i) for i in range(3)])
    frames = list(load_sequence(str(folder)))
    assert [frame.stamp for frame in frames] == pytest.approx([0, 1 / 30, 2 / 30], abs=1e-6)
    assert [frame.depth_delay for frame in frames] == pytest.approx([0, 1 / 25 - 1 / 30, 2 / 25 - 2 / 30], abs=1e-6)
    assert [frame.depth_delay for frame in load_sequence(str(folder), options=SourceOptions(fps=10))] == [0, 0, 0]


def test_pair_is_found_by_name_among_several_videos(folder: Path) -> None:
    write_colour(folder / "second.mkv", 15, 2)
    write_video(folder / "second_depth.mkv", 15, [depth_of(7), depth_of(8)])
    sequence = load_sequence(str(folder / "second.mkv"))
    assert isinstance(sequence, VideoSequence)
    assert_frame(sequence, 1, 1, 8)
    with pytest.raises(InputError, match=r"found rgb\.avi, second\.mkv, depth\.mkv, second_depth\.mkv; name them"):
        load_sequence(str(folder))


def test_each_of_several_pairs_is_found_by_its_name(folder: Path) -> None:
    """Names of which one begins with the other belong to different pairs; a lone video has no depth."""
    for number, name in enumerate(("take", "take2")):
        write_colour(folder / f"{name}.mkv", 15, 2)
        write_video(folder / f"{name}_depth.mkv", 15, [depth_of(7 + number), depth_of(8 + number)])
    for number, name in enumerate(("take", "take2")):
        sequence = load_sequence(str(folder / f"{name}.mkv"))
        assert isinstance(sequence, VideoSequence)
        assert_frame(sequence, 1, 1, 8 + number)
    with pytest.raises(InputError, match=r"rgb\.avi: expected one colour and one depth video, found rgb\.avi; name"):
        load_sequence(str(folder / "rgb.avi"))


def test_depth_video_alone_is_an_input_error(folder: Path) -> None:
    with pytest.raises(InputError, match=r"depth\.mkv: is a depth video by its name; give the colour video of "):
        load_sequence(str(folder / "depth.mkv"))


def test_progress_is_reported_for_every_colour_frame(folder: Path) -> None:
    reports: list[tuple[int, int | None]] = []
    load_sequence(str(folder), progress=lambda done, total: reports.append((done, total)))
    assert reports == [(i, 6) for i in range(1, 7)]


def test_8_bit_depth_is_an_input_error(folder: Path) -> None:
    (folder / "depth.mkv").unlink()
    write_colour(folder / "depth.mkv", 15, 3)
    with pytest.raises(InputError, match=r"depth\.mkv: depth is not one channel of 16 bits"):
        load_sequence(str(folder))


@pytest.mark.parametrize("name", ["rgb.avi", "depth.mkv"])
def test_undecodable_video_is_an_input_error(folder: Path, name: str) -> None:
    (folder / name).write_bytes(b"no video" * 100)
    with pytest.raises(InputError, match=rf"{name}: cannot be decoded as a video"):
        load_sequence(str(folder))


def test_equal_timestamps_are_an_input_error(folder: Path) -> None:
    """Matroska stores milliseconds, so that every second frame at 2000 Hz has the time of the one before."""
    (folder / "rgb.avi").unlink()
    write_colour(folder / "rgb.mkv", 2000, 6)
    with pytest.raises(InputError, match=r"rgb\.mkv: its timestamps do not increase; pass the frame rate with --fps"):
        load_sequence(str(folder))
    assert len(load_sequence(str(folder), options=SourceOptions(fps=30))) == 3


def test_missing_depth_video_is_an_input_error(folder: Path) -> None:
    (folder / "depth.mkv").unlink()
    with pytest.raises(InputError, match=r"rgb\.avi: expected one colour and one depth video, found rgb\.avi;"):
        load_sequence(str(folder / "rgb.avi"))


def test_video_of_another_size_than_the_camera_is_an_input_error(folder: Path) -> None:
    (folder / "camera.yaml").write_text(CAMERA_YAML.replace("width: 32", "width: 64"))
    with pytest.raises(InputError, match=r"rgb\.avi: has 32x24 pixels, but the camera has 64x24"):
        load_sequence(str(folder))[0]


def test_truncated_video_raises_after_its_last_frame(folder: Path) -> None:
    write_colour(folder / "rgb.avi", 30, 90)
    write_video(folder / "depth.mkv", 30, [depth_of(i) for i in range(90)])
    content = (folder / "rgb.avi").read_bytes()
    (folder / "rgb.avi").write_bytes(content[: len(content) // 2])
    sequence = load_sequence(str(folder))
    frames = iter(sequence)
    for _ in range(len(sequence)):
        next(frames)
    with pytest.raises(InputError, match=r"rgb\.avi: is truncated at \d\.\d of 3\.0 s; copy it again$"):
        next(frames)


def test_name_like_a_protocol_is_a_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """FFmpeg read the time of day as a protocol."""
    (folder / "rgb.avi").rename(folder / "10:30.avi")
    (folder / "depth.mkv").rename(folder / "10:30_depth.mkv")
    monkeypatch.chdir(folder)
    assert len(load_sequence("10:30.avi")) == 3


@pytest.mark.skipif(os.name == "nt", reason="all names are Unicode")
def test_name_that_is_not_utf8_is_an_input_error(folder: Path) -> None:
    """OpenCV ended the process."""
    renamed = folder.rename(folder.parent / os.fsdecode(b"v\xffid"))
    with pytest.raises(InputError, match=r"has a name that is not UTF-8; rename the file and its folders$"):
        load_sequence(str(renamed))
