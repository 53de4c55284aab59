"""Array files: round trip and identical bytes; foreign, damaged and inflated files."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from v3d_torch.errors import InputError, OutputError
from v3d_torch.io.array_file import open_array_file, write_array_file

ABOUT = {"format": "test", "version": 1}
ARRAYS = {"first": np.arange(6).reshape(2, 3), "second": np.zeros(0, np.int8)}


def read(path: Path, name: str = "first") -> np.ndarray:
    with open_array_file(path, "test", "a test file", "write it again") as file:
        return file.read(name)


def test_arrays_and_description_are_read_back(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_array_file(tmp_path / name, ABOUT, ARRAYS)
    with open_array_file(tmp_path / "a", "test", "a test file", "") as file:
        assert file.about == ABOUT
        for name, array in ARRAYS.items():
            assert np.array_equal(file.read(name), array) and file.read(name).dtype == array.dtype
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_wrong_files_are_rejected_in_one_line(tmp_path: Path) -> None:
    write_array_file(tmp_path / "other", {"format": "other"}, {})
    write_array_file(tmp_path / "list", ["test"], {})  # type: ignore[arg-type]
    (tmp_path / "text").write_text("text")
    np.savez(tmp_path / "pickle.npz", about=np.array([{"format": "test"}], dtype=object))
    for name in ("other", "list", "text", "pickle.npz"):
        with pytest.raises(InputError, match=rf"{name}: is not a test file or is damaged \(.*\); write it again"):
            read(tmp_path / name)
    with pytest.raises(InputError, match=r"none: cannot be read \(No such file"):
        read(tmp_path / "none")


def test_missing_array_is_reported_as_damage(tmp_path: Path) -> None:
    write_array_file(tmp_path / "file", ABOUT, ARRAYS)
    with pytest.raises(InputError, match=r"file: is not a test file or is damaged \(.*third"):
        read(tmp_path / "file", "third")


def test_file_that_unpacks_to_far_more_is_not_unpacked(tmp_path: Path) -> None:
    write_array_file(tmp_path / "file", ABOUT, ARRAYS)
    with (
        zipfile.ZipFile(tmp_path / "file", "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("zeros.npy", "w", force_zip64=True) as member,
    ):
        for _ in range(300):
            member.write(bytes(1 << 20))
    with pytest.raises(InputError, match="would unpack to"):
        read(tmp_path / "file")


@pytest.mark.parametrize("header", ["{'shape': (10,", "  a\n b", "'" + "''", "(" * 5000])
def test_damaged_header_of_an_array_is_an_input_error(tmp_path: Path, header: str) -> None:
    with zipfile.ZipFile(tmp_path / "file", "w") as archive:
        archive.writestr("about.npy", b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode())
    with pytest.raises(InputError, match=r"file: is not a test file or is damaged"):
        read(tmp_path / "file")


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compression_that_numpy_does_not_write_is_an_input_error(tmp_path: Path, compression: int) -> None:
    with zipfile.ZipFile(tmp_path / "file", "w", compression) as archive:
        archive.writestr("about.npy", bytes(100))
    content = bytearray((tmp_path / "file").read_bytes())
    content[45:48] = bytes(3)  # in the compressed data
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(InputError, match=r"file: is not a test file or is damaged \(.*another compression"):
        read(tmp_path / "file")


def test_error_names_the_file_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="below: cannot be written"):
        write_array_file(tmp_path / "file" / "below", ABOUT, ARRAYS)
