"""Folders of images without lists: pairs and timestamps from file names."""

from __future__ import annotations

from collections.abc import Iterator
from errno import EACCES
from pathlib import Path

import numpy as np
import pytest
from helpers.tiny_images import CAMERA_YAML, as_rgb, colour_of, depth_of, save

from v3d_torch.datasets import RGBDSequence, SourceOptions, load_sequence
from v3d_torch.datasets.image_files import frame_number, list_images, stamp_in_name
from v3d_torch.datasets.image_folder import ImageFolder
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.errors import InputError

FPS = SourceOptions(fps=10)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "camera.yaml").write_text(CAMERA_YAML)
    return folder


def fill(root: Path, colour: list[str], depth: list[str]) -> Path:
    """Save images with seeds 0, 1, 2 ... in the order of the given names."""
    for seed, name in enumerate(colour):
        save(root / name, colour_of(seed))
    for seed, name in enumerate(depth):
        save(root / name, depth_of(seed))
    return root


def assert_frames(sequence: RGBDSequence, stamps: list[float], seeds: list[tuple[int, int]]) -> None:
    assert isinstance(sequence, ImageFolder)
    assert sequence.stamps.tolist() == pytest.approx(stamps)
    for frame, (colour, depth) in zip(sequence, seeds, strict=True):
        assert np.array_equal(as_rgb(frame.image), colour_of(colour))
        np.testing.assert_allclose(frame.depth[0], depth_of(depth) / 1000, rtol=1e-6)


def test_images_of_two_folders_are_paired_in_order_of_their_numbers(root: Path) -> None:
    fill(root, [f"rgb/img{i}.png" for i in (9, 10, 100)], [f"depth/d_{i:03d}.png" for i in (1, 2, 3)])
    assert_frames(load_sequence(str(root), options=FPS), [0, 0.1, 0.2], [(0, 0), (1, 1), (2, 2)])


def test_images_with_equal_names_are_paired_if_one_is_missing(root: Path) -> None:
    fill(root, [f"color/{i}.png" for i in (7, 8, 9)], [f"depth_png/{i}.png" for i in (9, 7)])
    assert_frames(load_sequence(str(root), options=FPS), [0, 0.2], [(0, 1), (2, 0)])


def test_time_passes_at_the_frame_rate_also_where_depth_is_missing(root: Path) -> None:
    fill(root, [f"rgb/{i:04d}.png" for i in range(20)], [f"depth/{i:04d}.png" for i in range(20) if i not in (5, 6)])
    numbers = [i for i in range(20) if i not in (5, 6)]
    assert_frames(
        load_sequence(str(root), options=FPS), [i / 10 for i in numbers], [(n, i) for i, n in enumerate(numbers)]
    )


def test_frame_rate_is_that_of_colour_if_depth_has_half_of_it(root: Path) -> None:
    fill(root, [f"rgb/{i:04d}.png" for i in range(20)], [f"depth/{i:04d}.png" for i in range(0, 20, 2)])
    sequence = load_sequence(str(root), options=FPS)
    assert_frames(sequence, [i / 5 for i in range(10)], [(2 * i, i) for i in range(10)])
    assert isinstance(sequence, ImageFolder) and sequence.notes == [
        "10 of 20 colour images have no depth image of the same name and are left out (the last is 0019.png)"
    ]


def test_images_with_timestamps_as_names_are_paired_by_time(root: Path) -> None:
    colour = [f"rgb/{t}.png" for t in ("1305031102.5", "1305031102.12", "1305031103.0")]
    fill(root, colour, [f"depth/{t}.png" for t in ("1305031102.51", "1305031102.11", "1305031109.0")])
    sequence = load_sequence(str(root))
    assert_frames(sequence, [1305031102.12, 1305031102.5], [(1, 1), (0, 0)])
    assert isinstance(sequence, ImageFolder) and sequence.notes == [
        "1 of 3 colour images have no depth image within 20 ms and are left out (the last at 1305031103.000000 s)"
    ]


def test_depth_delay_is_the_same_with_and_without_lists(root: Path) -> None:
    stamps = [("1305031102.50", "1305031102.51"), ("1305031102.60", "1305031102.585")]
    fill(root, [f"rgb/{colour}.png" for colour, _ in stamps], [f"depth/{depth}.png" for _, depth in stamps])
    assert [frame.depth_delay for frame in load_sequence(str(root), options=FPS)] == [0, 0]
    delays = [frame.depth_delay for frame in load_sequence(str(root))]
    assert delays == pytest.approx([0.01, -0.015], abs=1e-6)
    for kind, names in zip(("rgb", "depth"), zip(*stamps, strict=True), strict=True):
        (root / f"{kind}.txt").write_text("".join(f"{name} {kind}/{name}.png\n" for name in names))
    listed = load_sequence(str(root))
    assert isinstance(listed, TUMSequence) and [frame.depth_delay for frame in listed] == delays


def test_depth_delay_is_zero_if_only_names_of_colour_are_timestamps(root: Path) -> None:
    fill(root, [f"rgb/{t}.png" for t in ("1.5", "1.6")], [f"depth/{i}.png" for i in range(2)])
    assert [frame.depth_delay for frame in load_sequence(str(root))] == [0, 0]


def test_timestamps_with_few_decimals_are_sorted_by_value(root: Path) -> None:
    """Association needs sorted timestamps, and 0.9 comes after 0.12."""
    times = [1.9, 1.12, 1.5, 1.125, 1.7, 1.65, 1.155]
    fill(root, [f"rgb/{t}.png" for t in times], [f"depth/{t + 0.001:.3f}.png" for t in times])
    order = sorted(range(len(times)), key=lambda i: times[i])
    assert_frames(load_sequence(str(root)), sorted(times), [(i, i) for i in order])
    assert_frames(load_sequence(str(root), options=FPS), [i / 10 for i in range(7)], [(i, i) for i in order])


def test_colour_and_depth_in_one_folder_are_paired_by_name(root: Path) -> None:
    fill(root, ["0_rgb.png", "1_rgb.png"], ["0_depth.png", "1_depth.png"])
    save(root / "0_mask.png", colour_of(7))
    assert_frames(load_sequence(str(root), options=FPS), [0, 0.1], [(0, 0), (1, 1)])


def test_image_with_words_for_both_kinds_in_its_name_is_depth(root: Path) -> None:
    fill(root, ["image_0.png", "image_1.png"], ["depth_image_0.png", "depth_image_1.png"])
    assert_frames(load_sequence(str(root), options=FPS), [0, 0.1], [(0, 0), (1, 1)])


def test_kind_at_the_start_of_names_is_ignored_in_pairing(root: Path) -> None:
    fill(root, ["color_000001.png", "color_000002.png"], ["depth_000002.png", "depth_000001.png"])
    assert_frames(load_sequence(str(root), options=FPS), [0, 0.1], [(0, 1), (1, 0)])


def test_names_that_differ_in_leading_zeros_are_paired(root: Path) -> None:
    """Some names are equal, but the others belong together as well."""
    numbers = [7, 8, 9, 10, 11, 100]
    fill(root, [f"rgb/{i}.png" for i in numbers], [f"depth/{i:02d}.png" for i in reversed(numbers)])
    assert_frames(load_sequence(str(root), options=FPS), [i / 10 for i in range(6)], [(i, 5 - i) for i in range(6)])


def test_equal_names_are_preferred_to_names_with_other_zeros(root: Path) -> None:
    fill(root, ["rgb/1.png", "rgb/02.png", "rgb/2.png"], ["depth/02.png", "depth/2.png", "depth/1.png"])
    sequence = load_sequence(str(root), options=FPS)
    assert len(sequence) == 3
    for frame in sequence:
        (colour,) = (seed for seed in range(3) if np.array_equal(as_rgb(frame.image), colour_of(seed)))
        np.testing.assert_allclose(frame.depth[0], depth_of((colour + 2) % 3) / 1000, rtol=1e-6)


def test_folder_beside_the_images_need_not_be_readable(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(root, ["rgb/1.png"], ["depth/1.png"])
    (root / "lost+found").mkdir()
    iterdir = Path.iterdir

    def refuse(path: Path) -> Iterator[Path]:
        if path.name == "lost+found":
            raise PermissionError(EACCES, "Permission denied", str(path))
        return iterdir(path)

    monkeypatch.setattr(Path, "iterdir", refuse)
    assert_frames(load_sequence(str(root), options=FPS), [0], [(0, 0)])


def test_few_images_without_a_partner_are_left_out(root: Path) -> None:
    fill(root, [f"rgb/{i}.png" for i in range(11)], [f"depth/{i}.png" for i in range(1, 11)] + ["depth/99.png"])
    stamps = [(i + 1) / 10 for i in range(10)]
    assert_frames(load_sequence(str(root), options=FPS), stamps, [(i + 1, i) for i in range(10)])


@pytest.mark.parametrize(
    ("name", "seconds", "number"),
    [
        ("1305031102.175304.png", 1305031102.175304, 175304),
        ("rgb_1305031102.175304.png", 1305031102.175304, 175304),
        ("1403636579763555584.png", 1403636579.763555584, 1403636579763555584),
        ("1403636579763555.jpg", 1403636579.763555, 1403636579763555),
        ("1403636579763.jpg", 1403636579.763, 1403636579763),
        ("cam0_1305031102.175304.png", 1305031102.175304, 175304),
        ("12.5.png", 12.5, 5),
        ("0012.5.png", 12.5, 5),
        ("rgb_0.033.png", 0.033, 33),
        ("2026-01-01_10-30-59.70.png", 1767263459.7, 70),
        ("rgb 2026-01-01 10:30:59.700123.png", 1767263459.700123, 700123),
        ("20260101_103059.9.png", 1767263459.9, 9),
        ("2026010110305970.png", 1767263459.7, 2026010110305970),
        ("PXL_20260101_103059700.jpg", 1767263459.7, 103059700),
        ("20260101_103059.jpg", 1767263459, 103059),
        ("20260101_103059_0001.jpg", None, 1),
        ("2026-13-01_10-30-59.70.png", None, 70),
        ("10-30-59.70.png", None, 70),
        ("shot_010.0008.png", None, 8),
        ("000120.png", None, 120),
        ("frame-000120.color.png", None, 120),
        ("rgb.png", None, None),
    ],
)
def test_file_name_gives_timestamp_and_frame_number(name: str, seconds: float | None, number: int | None) -> None:
    assert stamp_in_name(Path(name)) == (None if seconds is None else pytest.approx(seconds, abs=1e-6))
    assert frame_number(Path(name)) == number


def test_images_are_listed_in_numerical_order(tmp_path: Path) -> None:
    for name in ("b2.png", "b10.png", "a3.png", "b2.txt", ".b0.png"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["a3.png", "b2.png", "b10.png"]


@pytest.mark.parametrize(
    ("colour", "depth", "options", "message"),
    [
        (["rgb/1.png"], ["depth/1.png"], SourceOptions(), "file names such as 1.png are not timestamps; .*--fps"),
        (
            ["rgb/a.png", "rgb/b.png"],
            ["depth/x.png"],
            FPS,
            "has 2 colour and 1 depth images, of which 0 can be paired by name; give the two images of a frame the",
        ),
        (
            ["rgb/1.png", "rgb/2.png", "rgb/3.png"],
            ["depth/2.png", "depth/3.png", "depth/4.png"],
            FPS,
            "has 3 colour and 3 depth images, of which 2 can be paired by name; give the two images of a frame the",
        ),
        (["rgb/10.5.png"], ["depth/11.5.png"], FPS, "no colour image is within 0.02 s"),
        (
            ["rgb/2.9.png", "rgb/2.1.png", "rgb/2.10.png"],
            ["depth/2.9.png", "depth/2.1.png", "depth/2.10.png"],
            SourceOptions(),
            "2.1.png and 2.10.png have the same timestamp; pass the frame rate with --fps",
        ),
        (
            ["rgb/1.png", "color/1.png"],
            ["depth/1.png"],
            FPS,
            "has too many image folders .color, rgb, depth.; keep one folder",
        ),
        (["rgb/1.png"], [], FPS, "is not a sequence of a supported format"),
        (
            ["rgb/1.png"],
            ["depth/1.png"],
            SourceOptions(fps=10, rgb_topic="/a"),
            "a folder of images, which does not support --rgb-topic",
        ),
    ],
)
def test_invalid_image_folder_is_rejected(
    root: Path, colour: list[str], depth: list[str], options: SourceOptions, message: str
) -> None:
    fill(root, colour, depth)
    with pytest.raises(InputError, match=message) as caught:
        load_sequence(str(root), options=options)
    assert str(root) in str(caught.value) and "\n" not in str(caught.value)


def test_names_in_nanoseconds_since_the_start_of_the_computer_are_rejected(root: Path) -> None:
    """They have as many digits as milliseconds since 1970."""
    names = [f"{5_000_000_000_000 + i * 33_333_333}.png" for i in range(3)]
    fill(root, [f"rgb/{name}" for name in names], [f"depth/{name}" for name in names])
    with pytest.raises(
        InputError, match=r"mine: the images are 33333\.3 s apart .*; convert the timestamps to seconds"
    ):
        load_sequence(str(root))
    assert load_sequence(str(root), options=FPS).stamps.tolist() == pytest.approx([0, 0.1, 0.2])


def test_dates_and_times_as_names_are_in_order_across_a_minute(root: Path) -> None:
    names = ["2026-01-01_10-30-59.80.png", "2026-01-01_10-30-59.90.png", "2026-01-01_10-31-00.00.png"]
    fill(root, [f"rgb/{name}" for name in names], [f"depth/{name}" for name in names])
    assert_frames(load_sequence(str(root)), [1767263459.8, 1767263459.9, 1767263460.0], [(i, i) for i in range(3)])


def test_frame_numbers_after_a_dot_are_in_numerical_order(root: Path) -> None:
    names = [f"shot_010.{i}.png" for i in (8, 9, 10)]
    fill(root, [f"rgb/{name}" for name in names], [f"depth/{name}" for name in names])
    assert_frames(load_sequence(str(root), options=FPS), [0, 0.1, 0.2], [(i, i) for i in range(3)])
    with pytest.raises(InputError, match=r"file names such as shot_010\.8\.png are not timestamps; .*--fps"):
        load_sequence(str(root))


@pytest.mark.parametrize("rate", [90, 300])
def test_high_frame_rates_are_accepted(root: Path, rate: int) -> None:
    names = [f"{5 + i / rate:.6f}.png" for i in range(4)]
    fill(root, [f"rgb/{name}" for name in names], [f"depth/{name}" for name in names])
    assert len(load_sequence(str(root))) == 4


def test_names_that_are_less_than_a_millisecond_apart_are_not_timestamps(root: Path) -> None:
    names = [f"10.{i:04d}.png" for i in range(8, 12)]
    fill(root, [f"rgb/{name}" for name in names], [f"depth/{name}" for name in names])
    with pytest.raises(InputError, match=r"mine: the images are 0\.0001 s apart .*; .*, or pass .* --fps"):
        load_sequence(str(root))
    assert load_sequence(str(root), options=FPS).stamps.tolist() == pytest.approx([0, 0.1, 0.2, 0.3])


def test_image_folder_without_camera_and_file_instead_of_folder_are_rejected(root: Path) -> None:
    fill(root, ["rgb/1.png"], ["depth/1.png"])
    with pytest.raises(InputError, match="is not a sequence of a supported format"):
        load_sequence(str(root / "camera.yaml"))
    (root / "camera.yaml").unlink()
    with pytest.raises(InputError, match="has no camera parameters"):
        load_sequence(str(root), options=FPS)
