"""Folders in TUM layout, errors in them, and the search for sequences."""

from __future__ import annotations

import tarfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.tiny_images import CAMERA_YAML, HEIGHT, WIDTH, colour_of, depth_of
from PIL import Image

from v3d_torch.datasets import RGBDSequence, load_sequence, locate, tum
from v3d_torch.datasets.cameras import load_camera
from v3d_torch.datasets.depth_files import read_depth_file
from v3d_torch.datasets.images import read_colour
from v3d_torch.datasets.sequence_names import download_url
from v3d_torch.errors import DownloadError, GroundTruthWarning, InputError, OutputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import depth_to_metres

WALKING_XYZ = "rgbd_dataset_freiburg3_walking_xyz"


@pytest.fixture(autouse=True)
def isolated_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep all tests away from the user's own data and cache."""
    monkeypatch.setenv("V3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("V3D_DATA", raising=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three pairs of small images with depth 5 ms later, and a fourth depth image."""
    root = tmp_path / "sequence"
    for name in ("rgb", "depth"):
        (root / name).mkdir(parents=True)
    for i in range(3):
        Image.fromarray(colour_of(i)).save(root / "rgb" / f"{i}.png")
    for i in range(4):
        Image.fromarray(depth_of(i)).save(root / "depth" / f"{i}.png")
    (root / "rgb.txt").write_text("# color images\n" + "".join(f"{10 + i}.0 rgb/{i}.png\n" for i in range(3)))
    (root / "depth.txt").write_text("# depth maps\n" + "".join(f"{10 + i}.005 depth/{i}.png\n" for i in range(4)))
    (root / "camera.yaml").write_text(CAMERA_YAML)
    return root


def test_tum_frames_match_files(folder: Path) -> None:
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, RGBDSequence)
    assert (sequence.name, len(sequence), sequence.groundtruth) == ("sequence", 3, None)
    assert sequence.camera == PinholeCamera(30, 31, 15.5, 11.5, WIDTH, HEIGHT, depth_scale=1000)
    assert sequence.stamps.dtype == torch.float64
    assert sequence.stamps.tolist() == [10.0, 11.0, 12.0]
    for i, frame in enumerate(sequence):
        assert (frame.index, frame.stamp) == (i, 10.0 + i)
        assert frame.image.dtype == torch.uint8
        assert np.array_equal(frame.image.permute(1, 2, 0).numpy(), colour_of(i))
        assert frame.depth.dtype == torch.float32
        assert frame.depth.shape == (1, HEIGHT, WIDTH)
        np.testing.assert_allclose(frame.depth[0].numpy(), depth_of(i) / 1000.0, rtol=1e-6)


def test_convention_depth_is_in_metres_and_zero_or_saturated_is_missing(folder: Path) -> None:
    units = np.array([[0, 1, 5000, 65535]], dtype=np.uint16)
    Image.fromarray(units).save(folder / "depth.png")
    depth = depth_to_metres(read_depth_file(folder / "depth.png"), 5000)
    assert depth.tolist() == [[pytest.approx([0.0, 0.0002, 1.0, 0.0])]]


def test_convention_images_are_rgb(folder: Path) -> None:
    Image.new("RGB", (16, 16), (250, 120, 10)).save(folder / "a.png")
    Image.new("RGB", (16, 16), (250, 120, 10)).save(folder / "a.jpg", quality=100)
    assert read_colour(folder / "a.png")[:, 0, 0].tolist() == [250, 120, 10]
    assert (read_colour(folder / "a.jpg")[:, 8, 8].int() - torch.tensor([250, 120, 10])).abs().max() <= 2


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "RGBA", "LA", "1", "CMYK", "L jpeg"])
def test_decoded_colour_of_every_mode_equals_pillow(tmp_path: Path, mode: str) -> None:
    path = tmp_path / ("a.jpg" if mode in ("CMYK", "L jpeg") else "a.png")
    Image.fromarray(colour_of(0)).convert(mode.split()[0]).save(path)
    assert np.array_equal(read_colour(path).permute(1, 2, 0).numpy(), np.asarray(Image.open(path).convert("RGB")))


def test_images_of_a_real_sequence_equal_opencv(real_sequence: Callable[[str], Path]) -> None:
    folder = real_sequence("fr1_rpy")
    sequence = load_sequence("fr1/rpy", data_root=folder.parent)
    colour, depth = (sorted((folder / name).iterdir()) for name in ("rgb", "depth"))
    frame = sequence[100]
    assert np.array_equal(frame.image.permute(1, 2, 0).numpy(), cv2.imread(str(colour[100]), cv2.IMREAD_COLOR_RGB))
    expected = cv2.imread(str(depth[100]), cv2.IMREAD_UNCHANGED).astype(np.float32) / 5000
    assert np.array_equal(frame.depth[0].numpy(), expected)


@pytest.mark.parametrize("swapped", [False, True], ids=["colour first", "depth first"])
def test_associations_are_read_in_either_order(folder: Path, swapped: bool) -> None:
    sides = [[f"{10 + i}.0 rgb/{i}.png", f"{10 + i}.5 depth/{i}.png"] for i in (2, 0)]
    lines = [" ".join(reversed(pair) if swapped else pair) for pair in sides]
    (folder / "associations.txt").write_text("\n".join(lines))
    sequence = load_sequence(str(folder))
    assert sequence.stamps.tolist() == [10.0, 12.0]
    assert np.array_equal(sequence[1].image.permute(1, 2, 0).numpy(), colour_of(2))


@pytest.mark.parametrize("swapped", [False, True], ids=["colour first", "depth first"])
def test_order_of_associations_is_recognised_if_the_first_file_is_broken(folder: Path, swapped: bool) -> None:
    (folder / "depth" / "0.png").write_bytes(b"")
    sides = [[f"{10 + i}.0 rgb/{i}.png", f"{10 + i}.5 depth/{i}.png"] for i in (0, 1)]
    lines = [" ".join(reversed(pair) if swapped else pair) for pair in sides]
    (folder / "associations.txt").write_text("\n".join(lines))
    sequence = load_sequence(str(folder), skip_broken=True)
    assert sequence.stamps.tolist() == [10.0, 11.0]
    assert np.array_equal(sequence[1].image.permute(1, 2, 0).numpy(), colour_of(1))


def test_size_of_the_images_is_known_although_the_first_frame_is_broken(folder: Path) -> None:
    folder = folder.rename(folder.with_name("rgbd_dataset_freiburg3_walking_xyz"))  # its unit of depth is known
    (folder / "camera.yaml").unlink()
    (folder / "K.txt").write_text("30 0 15.5\n0 31 11.5\n0 0 1\n")
    (folder / "rgb" / "0.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"rgb/0\.png: is not a PNG, JPEG or TIFF image"):
        load_sequence(str(folder))
    camera = load_sequence(str(folder), skip_broken=True).camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    for i in (1, 2):
        (folder / "rgb" / f"{i}.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"rgb/0\.png: is not a PNG, JPEG or TIFF image"):
        load_sequence(str(folder), skip_broken=True)


def test_duplicate_and_unsorted_stamps_are_sorted_once(folder: Path) -> None:
    (folder / "rgb.txt").write_text("12 rgb/2.png\n10 rgb/0.png\n10 rgb/1.png\n")
    sequence = load_sequence(str(folder))
    assert sequence.stamps.tolist() == [10.0, 12.0]
    assert np.array_equal(sequence[0].image.permute(1, 2, 0).numpy(), colour_of(0))


def test_ground_truth_file_is_read(folder: Path) -> None:
    (folder / "groundtruth.txt").write_text("# truth\n10 1 2 3 0 0 0 1\n11 4 5 6 0 0 1 0\n")
    groundtruth = load_sequence(str(folder)).groundtruth
    assert groundtruth is not None
    assert groundtruth.T_wc[:, :3, 3].tolist() == [[1, 2, 3], [4, 5, 6]]


def test_offset_of_inverse_depth_corrects_the_depth_of_every_frame(folder: Path) -> None:
    measured = load_sequence(str(folder))
    corrected = load_sequence(str(folder), camera=replace(measured.camera, inverse_depth_offset=0.01))
    for before, after in zip(measured, corrected, strict=True):
        known = before.depth > 0
        torch.testing.assert_close(1 / after.depth[known], 1 / before.depth[known] + 0.01)
        assert not known.all() and (after.depth[~known] == 0).all()


@pytest.mark.parametrize("index", [3, -1])
def test_index_out_of_range_raises_index_error(folder: Path, index: int) -> None:
    with pytest.raises(IndexError, match=f"has 3 frames, index {index} is out of range"):
        load_sequence(str(folder))[index]


def test_frame_index_must_be_an_integer(folder: Path) -> None:
    sequence = load_sequence(str(folder))
    frame = sequence[np.int64(1)]
    assert (frame.index, type(frame.index)) == (1, int)
    for wrong in (slice(0, 2), "1", 1.0, None):
        with pytest.raises(
            InputError, match=r"a frame index must be an integer, got .*; read several frames with itertools\.islice"
        ):
            sequence[wrong]


def test_camera_of_unsupported_type_is_rejected(folder: Path) -> None:
    for wrong, kind in ((np.eye(3), "ndarray"), ({"fx": 500}, "dict")):
        with pytest.raises(
            InputError, match=f"^camera is a {kind}; pass a PinholeCamera, the name of a preset or a file"
        ):
            load_sequence(str(folder), camera=wrong)


def camera_after(change: Callable[[Path], object], folder: Path, **arguments: str) -> PinholeCamera:
    change(folder)
    return tum.TUMSequence(folder, **arguments).camera  # opened directly: load_sequence also checks the image size


def test_camera_is_chosen_by_priority(folder: Path) -> None:
    own = load_camera(folder / "camera.yaml")
    assert camera_after(lambda f: (f / "K.txt").write_text("1 2 3 4 5000 640 480"), folder) == own
    assert camera_after(lambda f: None, folder, camera="tum_fr2") == load_camera("tum_fr2")
    assert load_sequence(str(folder), camera=own).camera is own
    assert camera_after(lambda f: (f / "camera.yaml").unlink(), folder).fx == 1
    (folder / "K.txt").unlink()
    for name, preset in [("rgbd_dataset_freiburg2_desk", "tum_fr2"), ("my_fr1_copy", "tum_fr1")]:
        folder = folder.rename(folder.with_name(name))
        assert tum.TUMSequence(folder).camera == load_camera(preset)
    with pytest.raises(InputError, match=r"has no camera parameters.*--camera"):
        load_sequence(str(folder.rename(folder.with_name("unknown"))))


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def as_jpeg(folder: Path) -> None:
    Image.fromarray(colour_of(0)).save(folder / "rgb" / "0.jpg")
    truncate(folder / "rgb" / "0.jpg")
    (folder / "rgb.txt").write_text("10 rgb/0.jpg\n")


def swap_lists(folder: Path) -> None:
    colour, depth = (folder / "rgb.txt").read_text(), (folder / "depth.txt").read_text()
    (folder / "rgb.txt").write_text(depth)
    (folder / "depth.txt").write_text(colour)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "rgb.txt").unlink(), "has no rgb.txt"),
        (lambda f: (f / "depth.txt").unlink(), "has no depth.txt"),
        (lambda f: (f / "rgb.txt").write_text("# nothing\n"), "rgb.txt: lists no images"),
        (lambda f: (f / "associations.txt").write_text(""), "associations.txt: lists no images"),
        (lambda f: (f / "rgb.txt").write_text("10 rgb/0.png\nnow rgb/1.png"), "line 2 has 'now', expected a timestamp"),
        (lambda f: (f / "rgb.txt").write_text("nan rgb/1.png"), "line 1 has 'nan', expected a timestamp"),
        (lambda f: (f / "rgb.txt").write_text("rgb/1.png"), "line 1 is 'rgb/1.png', expected a timestamp and a file"),
        (lambda f: (f / "rgb.txt").write_bytes(b"\xff\xfe1\x000"), "is not a UTF-8 text file"),
        (lambda f: (f / "associations.txt").write_text("10 rgb/0.png depth/0.png"), "timestamp, file, timestamp, file"),
        (lambda f: (f / "depth.txt").write_text("10.5 depth/0.png"), "no timestamp in rgb.txt is within 0.02 s"),
        (lambda f: (f / "rgb" / "0.png").unlink(), "rgb/0.png: is listed but does not exist .1 missing"),
        (lambda f: truncate(f / "rgb" / "0.png"), "rgb/0.png: is truncated"),
        (lambda f: truncate(f / "depth" / "0.png"), "depth/0.png: is truncated"),
        (lambda f: (f / "depth" / "0.png").write_bytes(b""), "depth/0.png: is (not a PNG|truncated)"),
        (as_jpeg, "rgb/0.jpg: is truncated"),
        (
            lambda f: Image.fromarray(depth_of(0).astype(np.uint8)).save(f / "depth" / "0.png"),
            "depth/0.png: is an 8-bit image, depth needs 16 bits",
        ),
        (swap_lists, "depth image, expected a colour image; check that colour and depth are not swapped"),
        (lambda f: Image.fromarray(colour_of(0)).save(f / "depth" / "0.png"), "colour image, expected a depth image"),
        (
            lambda f: Image.new("RGB", (8, 8)).save(f / "rgb" / "0.png"),
            "depth/0.png: has 32x24 pixels, but its colour image has 8x8",
        ),
        (lambda f: Image.new("I;16", (9, 8)).save(f / "depth" / "0.png"), "depth/0.png: has 9x8 pixels"),
    ],
)
def test_damaged_tum_folder_is_rejected(folder: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(folder)
    with pytest.raises(InputError, match=message) as caught:
        load_sequence(str(folder))[0]
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def test_damaged_ground_truth_gives_a_warning_and_all_frames(folder: Path) -> None:
    (folder / "groundtruth.txt").write_text("a b c")
    with pytest.warns(GroundTruthWarning, match="line 1 is 'a b c'.*continuing without ground truth") as caught:
        sequence = load_sequence(str(folder))
    assert [Path(warning.filename) for warning in caught] == [Path(__file__)]  # the caller's line
    assert len(list(sequence)) == len(sequence) and sequence.groundtruth is None
    assert isinstance(sequence, tum.TUMSequence)
    assert str(sequence.groundtruth_error).startswith(f"{folder / 'groundtruth.txt'}: line 1 is 'a b c'")


def test_error_for_folder_of_sequences_suggests_one_of_them(folder: Path) -> None:
    message = rf"^{folder.parent}: is not a sequence but contains 1, such as {folder.name}; pass {folder}$"
    with pytest.raises(InputError, match=message):
        load_sequence(str(folder.parent))


def test_file_or_missing_folder_is_not_a_tum_sequence(folder: Path) -> None:
    with pytest.raises(InputError, match="is not a folder"):
        tum.TUMSequence(folder / "rgb.txt")
    with pytest.raises(InputError, match="does not exist"):
        tum.TUMSequence(folder / "nowhere")


# Search for sequences


@pytest.mark.parametrize("folder_name", [WALKING_XYZ, "fr3_walking_xyz", "freiburg3_walking_xyz", "fr3_w_xyz"])
def test_sequence_is_found_by_name_in_root_environment_and_cache(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder_name: str
) -> None:
    root = tmp_path / "cache"
    root.mkdir()
    folder.rename(root / folder_name)
    assert load_sequence("fr3/w/xyz").name == "fr3/w/xyz"
    data = root.rename(tmp_path / "data")
    assert len(load_sequence("fr3/w/xyz", data_root=data, download=False)) == 3
    monkeypatch.setenv("V3D_DATA", str(data))
    assert len(load_sequence("fr3/walking_xyz", download=False)) == 3


def test_data_root_is_the_variable_only_if_the_sequence_is_found_there(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert locate.data_root_of("sequence", None) is None
    monkeypatch.chdir(tmp_path.parent)
    monkeypatch.setenv("V3D_DATA", tmp_path.name)
    assert locate.data_root_of("sequence", None) == tmp_path
    assert locate.data_root_of("sequence", Path("elsewhere")) == tmp_path.parent / "elsewhere"
    (tmp_path / "fr3_w_xyz").mkdir()
    assert locate.data_root_of("fr3/w/xyz", None) == tmp_path
    for name in ("demo", "realsense:", "cache"):
        (tmp_path / name).mkdir()
    (tmp_path / "cache" / "fr1_rpy").mkdir()
    for name in ("demo", "realsense:", "", "fr1/rpy", "unknown", "x" * 5000, str(folder)):
        assert locate.data_root_of(name, None) is None, name


@pytest.mark.parametrize("name", ["sequence", "room", "walking_xyz"])
def test_any_folder_in_data_root_is_found_and_keeps_its_name(name: str, folder: Path) -> None:
    folder.rename(folder.with_name(name))
    assert load_sequence(name, data_root=folder.parent).name == name


def test_common_name_without_such_a_folder_is_not_downloaded() -> None:
    with pytest.raises(InputError, match=r"^room: is not a file, .* did you mean .*fr1/room"):
        load_sequence("room")


def test_demo_is_rendered_to_the_cache(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Path, str]] = []

    def ensure(cache: Path, progress: object, name: str) -> Path:
        calls.append((cache, name))
        return folder

    monkeypatch.setattr("v3d_torch.datasets.demo.ensure_demo", ensure)
    for name in ("demo", "demo:sitting"):
        assert load_sequence(name).name == name
    assert calls == [(tmp_path / "cache", "demo"), (tmp_path / "cache", "demo:sitting")]


def test_unknown_name_suggests_similar_ones() -> None:
    with pytest.raises(InputError, match=r"fr3/w/xzy: is not a file, .* did you mean fr3/w/xyz or"):
        load_sequence("fr3/w/xzy")


def test_failed_download_explains_manual_download(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(url: str, *_: object, **__: object) -> None:
        raise DownloadError(f"{url}: cannot be reached")

    monkeypatch.setattr(locate, "fetch", refuse)
    with pytest.raises(DownloadError) as caught:
        load_sequence("fr3/w/xyz", data_root=tmp_path / "data")
    for part in (
        "fr3/w/xyz: is not in",
        download_url(WALKING_XYZ),
        f"the folder {WALKING_XYZ} to {tmp_path / 'data'}",
    ):
        assert part in str(caught.value)
    with pytest.raises(InputError, match=f"download {download_url(WALKING_XYZ)}, unpack it"):
        load_sequence("fr3/w/xyz", download=False)


@pytest.mark.parametrize("given_root", [True, False], ids=["into data_root", "into the cache"])
def test_sequence_is_downloaded_once(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given_root: bool
) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    monkeypatch.setenv("V3D_DATA", str(shared))
    fetched: list[str] = []

    def serve(url: str, target: Path, **_: object) -> Path:
        fetched.append(url)
        target.parent.mkdir(parents=True, exist_ok=True)
        with tarfile.open(target, "w:gz") as tar:
            tar.add(folder, WALKING_XYZ)
        return target

    monkeypatch.setattr(locate, "fetch", serve)
    root = tmp_path / "data" if given_root else tmp_path / "cache"
    for _ in range(2):
        sequence = load_sequence("fr3/w/xyz", data_root=root if given_root else None)
        assert (sequence.name, len(sequence)) == ("fr3/w/xyz", 3)
    assert fetched == [download_url(WALKING_XYZ)]
    assert [path.name for path in root.iterdir() if not path.name.startswith(".")] == [WALKING_XYZ]
    assert list(shared.iterdir()) == []


def test_damaged_archive_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def serve(url: str, target: Path, **_: object) -> Path:
        target.write_bytes(b"no archive")
        return target

    monkeypatch.setattr(locate, "fetch", serve)
    with pytest.raises(InputError, match="not a complete tar archive"):
        load_sequence("fr3/w/xyz")
    assert [path.name for path in (tmp_path / "cache").iterdir() if not path.name.startswith(".")] == []


@pytest.mark.parametrize(
    ("name", "frames", "poses"),
    [("fr1_rpy", 694, 2742), ("walkers_desk", 200, 200), ("crowd_rpy", 180, 180), ("walkers_room", 160, 160)],
)
def test_real_sequence_has_all_frames_and_poses(
    real_sequence: Callable[[str], Path], name: str, frames: int, poses: int
) -> None:
    sequence = load_sequence(name, data_root=real_sequence(name).parent)
    assert len(sequence) == frames
    assert sequence.groundtruth is not None
    assert len(sequence.groundtruth) == poses
    assert bool((sequence.stamps.diff() > 0).all())
    frame = sequence[frames - 1]
    assert (frame.image.shape, frame.depth.shape) == ((3, 480, 640), (1, 480, 640))
    assert 0.3 < float(frame.depth[frame.depth > 0].median()) < 6


def test_lists_of_fr1_rpy_give_the_pairs_of_its_associations(
    real_sequence: Callable[[str], Path], tmp_path: Path
) -> None:
    source, copy = real_sequence("fr1_rpy"), tmp_path / "fr1_rpy"
    copy.mkdir()
    for name in ("rgb", "depth", "rgb.txt", "depth.txt"):
        (copy / name).symlink_to(source / name)
    assert load_sequence(str(copy)).stamps.tolist() == load_sequence(str(source)).stamps.tolist()
    assert [pair.depth for pair in tum._read_pairs(copy)[0]] == [pair.depth for pair in tum._read_pairs(source)[0]]


def test_archive_stays_if_there_is_no_space_to_extract_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    downloads: list[Path] = []

    def download(url: str, target: Path, **_: object) -> None:
        downloads.append(target)
        target.write_bytes(b"archive")

    def fail(archive: Path, folder: Path) -> None:
        raise OutputError(f"{folder}: cannot be extracted (No space left on device); choose another --data-root")

    monkeypatch.setattr(locate, "fetch", download)
    monkeypatch.setattr(locate, "extract_tar", fail)
    for _ in range(2):
        with pytest.raises(OutputError, match="No space left on device"):
            load_sequence("fr1/xyz", data_root=tmp_path)
    assert len(downloads) == 1 and downloads[0].read_bytes() == b"archive"
