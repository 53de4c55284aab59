"""Depth in files: 16-bit images, floating-point TIFF, NumPy arrays and OpenEXR."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.tiny_images import CAMERA_YAML, HEIGHT, WIDTH, colour_of, depth_of, save
from numpy.typing import NDArray
from PIL import Image

from v3d_torch.datasets import SourceOptions, load_sequence
from v3d_torch.datasets.depth_files import is_depth_file, read_depth_file
from v3d_torch.datasets.images import image_size
from v3d_torch.errors import InputError

METRES = np.random.default_rng(0).uniform(0.5, 4.0, (HEIGHT, WIDTH)).astype(np.float32)


def save_exr(path: Path, channels: dict[str, NDArray[Any]]) -> None:
    library = pytest.importorskip("OpenEXR")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    library.File(header, channels).write(str(path))


WRITERS: dict[str, Callable[[Path, NDArray[Any]], object]] = {
    ".tiff": lambda path, metres: Image.fromarray(metres).save(path),
    ".npy": np.save,
    ".exr": lambda path, metres: save_exr(path, {"Z": metres}),
}
"""Functions that write depth in metres, by the suffix of the file."""


@pytest.mark.parametrize("suffix", WRITERS)
def test_depth_in_metres_is_read_exactly(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"depth{suffix}"
    WRITERS[suffix](path, METRES)
    depth = read_depth_file(path)
    assert depth.dtype == np.float32 and np.array_equal(depth, METRES) and is_depth_file(path)


@pytest.mark.parametrize("maximum", [4095, 65535])
@pytest.mark.parametrize("kind", ["P5", "P2"])
def test_values_of_a_pgm_image_are_not_scaled(tmp_path: Path, kind: str, maximum: int) -> None:
    units = np.linspace(0, maximum, HEIGHT * WIDTH).astype(np.uint16).reshape(HEIGHT, WIDTH)
    pixels = units.astype(">u2").tobytes() if kind == "P5" else " ".join(map(str, units.flatten())).encode()
    path = tmp_path / "depth.pgm"
    path.write_bytes(f"{kind}\n# depth\n{WIDTH} {HEIGHT}\n{maximum}\n".encode() + pixels)
    depth = read_depth_file(path)
    assert depth.dtype == np.uint16 and np.array_equal(depth, units)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"depth\.pgm: is truncated or damaged"):
        read_depth_file(path)


@pytest.mark.parametrize("layout", ["folder", "TUM"])
@pytest.mark.parametrize("suffix", WRITERS)
def test_sequence_with_depth_in_metres_is_read(tmp_path: Path, suffix: str, layout: str) -> None:
    """The depth scale of the camera, if there is one, belongs to whole numbers."""
    (tmp_path / "depth").mkdir()
    for i in range(2):
        save(tmp_path / "rgb" / f"{i}.png", colour_of(i))
        metres = METRES + np.float32(i)
        metres[0, :3] = [np.nan, -1, np.inf]
        WRITERS[suffix](tmp_path / "depth" / f"{i}{suffix}", metres)
    text = CAMERA_YAML if layout == "TUM" else CAMERA_YAML.replace("depth_scale: 1000\n", "")
    (tmp_path / "camera.yaml").write_text(text)
    if layout == "TUM":
        lines = [f"{i}.0 depth/{i}{suffix} {i}.0 rgb/{i}.png\n" for i in range(2)]  # depth first
        (tmp_path / "associations.txt").write_text("".join(lines))
    options = SourceOptions(fps=10) if layout == "folder" else None
    sequence = load_sequence(str(tmp_path), options=options)
    assert len(sequence) == 2
    for i in range(2):
        depth = sequence[i].depth[0].numpy()
        assert depth[0, :3].tolist() == [0, 0, 0] and np.array_equal(depth[1:], METRES[1:] + np.float32(i))


def test_whole_numbers_in_a_numpy_array_are_units(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", depth_of(0)[..., None])
    assert np.array_equal(read_depth_file(tmp_path / "a.npy"), depth_of(0))


@pytest.mark.parametrize(
    "channels",
    [
        {"Y": METRES},
        {"RGB": np.dstack(3 * [METRES])},
        {"ViewLayer.Depth.Z": METRES, "ViewLayer.Combined.R": np.zeros_like(METRES)},
        {"V": METRES.astype(np.float16)},
    ],
    ids=["Y", "RGB", "layers", "half precision"],
)
def test_channel_of_depth_in_openexr_is_found(tmp_path: Path, channels: dict[str, NDArray[Any]]) -> None:
    save_exr(tmp_path / "a.exr", channels)
    np.testing.assert_allclose(read_depth_file(tmp_path / "a.exr"), METRES, rtol=1e-3)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (
            np.zeros((4, 5, 3), np.float32),
            r"is a NumPy array of float32 with shape \(4, 5, 3\), not a depth image; save",
        ),
        (np.zeros((4, 5), np.uint8), r"is a NumPy array of uint8 with shape \(4, 5\), not a depth image"),
        (np.zeros((4, 5), np.complex64), "is a NumPy array of complex64"),
        (np.array([[None]]), "is truncated or not a NumPy array"),
    ],
)
def test_array_that_is_no_depth_image_is_rejected(tmp_path: Path, array: NDArray[Any], message: str) -> None:
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match=f"a.npy: {message}"):
        read_depth_file(tmp_path / "a.npy")


def test_array_that_fills_the_memory_is_rejected(tmp_path: Path) -> None:
    header = np.lib.format.open_memmap(tmp_path / "a.npy", mode="w+", dtype=np.uint16, shape=(40000, 40000))
    del header
    with pytest.raises(InputError, match="has more than 64 million pixels according to its header"):
        read_depth_file(tmp_path / "a.npy")


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".tiff"])
@pytest.mark.parametrize("content", [b"", b"v/1\x01\x02\0\0\0channels\0chlist\0" + bytes(300), b"\x93NUMPY\x01\0v\0{"])
def test_file_of_another_format_is_rejected(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"a{suffix}: is (truncated or )?not .*; copy or export it again"):
        read_depth_file(path)
    path.unlink()
    with pytest.raises(InputError, match=f"a{suffix}: (cannot be read|is listed but does not exist)"):
        read_depth_file(path)


def test_openexr_image_of_other_channels_or_size_is_rejected(tmp_path: Path) -> None:
    save_exr(tmp_path / "a.exr", {"normal.X": METRES})
    with pytest.raises(InputError, match=r"has the channels normal.X; export depth, in metres, as the channel Z"):
        read_depth_file(tmp_path / "a.exr")
    save_exr(tmp_path / "a.exr", {"Z": METRES})
    content = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"a.exr: is truncated or damaged; copy or download it again"):
        read_depth_file(tmp_path / "a.exr")
    window = content.index(b"box2i\0") + 10
    (tmp_path / "a.exr").write_bytes(content[: window + 8] + b"\xff\xff\0\0\xff\xff\0\0" + content[window + 16 :])
    with pytest.raises(InputError, match="has more than 64 million pixels"):
        read_depth_file(tmp_path / "a.exr")


def test_openexr_image_with_many_channels_is_not_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if it states a small size before the actual one, in another attribute."""
    values = HEIGHT * WIDTH
    monkeypatch.setattr("v3d_torch.datasets.depth_files._MAX_EXR_VALUES", 4 * values)
    save_exr(tmp_path / "a.exr", dict.fromkeys("ZRGB", METRES))
    assert np.array_equal(read_depth_file(tmp_path / "a.exr"), METRES)
    save_exr(tmp_path / "a.exr", dict.fromkeys("ZRGBA", METRES))
    with pytest.raises(InputError, match=r"a.exr: has more than .* values in its channels; export depth alone"):
        read_depth_file(tmp_path / "a.exr")
    library = pytest.importorskip("OpenEXR")
    small = "dataWindow\0box2i\0\x10\0\0\0" + "\0" * 16
    library.File({"a": small, "type": library.scanlineimage}, {"Z": METRES}).write(str(tmp_path / "a.exr"))
    assert small.encode() in (tmp_path / "a.exr").read_bytes()
    monkeypatch.setattr("v3d_torch.datasets.depth_files.MAX_PIXELS", values - 1)
    with pytest.raises(InputError, match=r"a.exr: has more than .* million pixels"):
        read_depth_file(tmp_path / "a.exr")


def test_openexr_without_its_library_names_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.exr").write_bytes(b"v/1\x01dataWindow\0box2i\0\x10\0\0\0" + bytes(16))
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r"a.exr: reading OpenEXR needs a library \(.*\); run pip install OpenEXR"):
        read_depth_file(tmp_path / "a.exr")


def test_tiff_of_another_kind_is_rejected(tmp_path: Path) -> None:
    import tifffile

    tifffile.imwrite(tmp_path / "a.tiff", METRES.astype(np.float64))
    with pytest.raises(InputError, match=r"a.tiff: is a TIFF image of an unsupported kind; export depth as 16-bit PNG"):
        read_depth_file(tmp_path / "a.tiff")


def test_only_the_first_bytes_of_a_tiff_of_another_kind_are_read_for_its_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "read_bytes", Mock(side_effect=MemoryError))
    for name, content, cause in (
        ("a.tiff", b"MM\0*", "is a TIFF image of an unsupported kind"),
        ("a.png", b"MM\0", "is not a PNG, JPEG or TIFF image"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=cause):
            image_size(tmp_path / name)


def test_depth_in_millimetres_in_floating_point_is_rejected(tmp_path: Path) -> None:
    save(tmp_path / "rgb" / "0.png", colour_of(0))
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth" / "0.npy", 1000 * METRES)
    (tmp_path / "camera.yaml").write_text(CAMERA_YAML.replace("depth_scale: 1000\n", ""))
    with pytest.raises(
        InputError, match=r"is 2.*e.03 m, although depth in floating point is in metres; export it in met"
    ):
        load_sequence(str(tmp_path), options=SourceOptions(fps=10))
