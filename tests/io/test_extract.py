"""Extraction of archives: top folder, limits, damaged archives, and members that lead outside."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import numpy as np
import pytest
from helpers.folders import names_in

from v3d_torch.errors import InputError, OutputError
from v3d_torch.io.extract import extract_tar


def write_archive(path: Path, *members: tuple[tarfile.TarInfo, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as tar:
        for info, content in members:
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return path


def file_member(name: str, content: bytes = b"content") -> tuple[tarfile.TarInfo, bytes]:
    return tarfile.TarInfo(name), content


def link_member(name: str, to: str, kind: bytes) -> tuple[tarfile.TarInfo, bytes]:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, to
    return info, b""


@pytest.mark.parametrize("top", ["sequence/", ""])
def test_only_top_folder_is_stripped(tmp_path: Path, top: str) -> None:
    archive = write_archive(tmp_path / "a.tgz", file_member(f"{top}rgb.txt"), file_member(f"{top}rgb/1.png", b"image"))
    extract_tar(archive, tmp_path / "out" / "seq")
    paths = sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*"))
    assert paths == ["seq", "seq/rgb", "seq/rgb.txt", "seq/rgb/1.png"]
    assert (tmp_path / "out" / "seq" / "rgb" / "1.png").read_bytes() == b"image"


@pytest.mark.parametrize(
    "member",
    [
        file_member("../outside"),
        file_member("seq/../../outside"),
        link_member("seq/link", "../../outside", tarfile.SYMTYPE),
        link_member("seq/link", "rgb.txt", tarfile.SYMTYPE),
        link_member("seq/link", "/etc/passwd", tarfile.SYMTYPE),
        link_member("seq/link", "../outside", tarfile.LNKTYPE),
        link_member("seq/device", "", tarfile.CHRTYPE),
        link_member("seq/pipe", "", tarfile.FIFOTYPE),
    ],
    ids=["parent", "parent inside", "symbolic link", "link inside", "absolute link", "hard link", "device", "pipe"],
)
def test_members_outside_the_folder_and_special_files_are_rejected(
    tmp_path: Path, member: tuple[tarfile.TarInfo, bytes]
) -> None:
    (tmp_path / "box").mkdir()
    archive = write_archive(tmp_path / "a.tgz", file_member("seq/rgb.txt"), member)
    with pytest.raises(InputError, match="is unsafe, a member leads outside or is not a plain file"):
        extract_tar(archive, tmp_path / "box" / "seq")
    assert names_in(tmp_path) == ["a.tgz", "box"]
    assert names_in(tmp_path / "box") == []


def test_chain_of_links_with_a_long_path_writes_nothing_outside(tmp_path: Path) -> None:
    """The filter of Python before 3.11.13 and 3.12.11 does not resolve the links of a path of more than 4096 bytes."""
    members, folder = [], ""
    for name in "abcdefghijklmnop":
        info = tarfile.TarInfo(f"{folder}{'d' * 247}")
        info.type, info.mode = tarfile.DIRTYPE, 0o755
        members += [(info, b""), link_member(f"{folder}{name}", "d" * 247, tarfile.SYMTYPE)]
        folder += f"{'d' * 247}/"
    long_link = f"{'/'.join('abcdefghijklmnop')}/{'l' * 254}"
    members.append(link_member(long_link, "../" * 16, tarfile.SYMTYPE))
    members += [link_member("escape", f"{long_link}/../..", tarfile.SYMTYPE), file_member("escape/outside")]
    (tmp_path / "box").mkdir()
    archive = write_archive(tmp_path / "a.tgz", *members)
    with pytest.raises(InputError, match="is unsafe, a member leads outside or is not a plain file"):
        extract_tar(archive, tmp_path / "box" / "seq")
    assert names_in(tmp_path) == ["a.tgz", "box"]


def test_absolute_names_are_extracted_inside_the_folder(tmp_path: Path) -> None:
    archive = write_archive(tmp_path / "a.tgz", file_member("/seq/rgb.txt"))
    extract_tar(archive, tmp_path / "out")
    assert names_in(tmp_path / "out") == ["rgb.txt"]


def test_total_size_is_limited(tmp_path: Path) -> None:
    archive = write_archive(tmp_path / "a.tgz", file_member("seq/a", bytes(600)), file_member("seq/b", bytes(600)))
    with pytest.raises(InputError, match="more than 1000 bytes"):
        extract_tar(archive, tmp_path / "out", max_bytes=1000)
    assert names_in(tmp_path) == ["a.tgz"]
    extract_tar(archive, tmp_path / "out", max_bytes=1200)


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.999])
def test_truncated_archive_is_an_input_error(tmp_path: Path, keep: float) -> None:
    archive = write_archive(tmp_path / "a.tgz", file_member("seq/a", np.random.default_rng(0).bytes(50_000)))
    archive.write_bytes(archive.read_bytes()[: int(keep * archive.stat().st_size)])
    with pytest.raises(InputError, match="not a complete tar archive"):
        extract_tar(archive, tmp_path / "out")
    assert names_in(tmp_path) == ["a.tgz"]


@pytest.mark.parametrize("kind", ["gz", "bz2", "xz"])
@pytest.mark.parametrize("position", [0.3, 0.6, 0.999])
def test_changed_byte_is_an_input_error(tmp_path: Path, kind: str, position: float) -> None:
    """Also behind the last member, which `tarfile` does not read."""
    path = tmp_path / "a.tgz"
    with tarfile.open(path, f"w:{kind}") as tar:
        info, content = file_member("seq/a", np.random.default_rng(0).bytes(20_000))
        info.size = len(content)
        tar.addfile(info, io.BytesIO(content))
    content = bytearray(path.read_bytes())
    content[int(position * len(content))] ^= 0x55
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a complete tar archive"):
        extract_tar(path, tmp_path / "out")
    assert names_in(tmp_path) == ["a.tgz"]


def test_damaged_header_is_not_the_end_of_the_archive(tmp_path: Path) -> None:
    path = tmp_path / "a.tar"
    with tarfile.open(path, "w:") as tar:
        for name in ("seq/a", "seq/b"):
            tar.addfile(tarfile.TarInfo(name))
    content = bytearray(path.read_bytes())
    content[512 + 10] ^= 0x55  # in the name of the second member, which the checksum of its header covers
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"not a complete tar archive \(.*checksum"):
        extract_tar(path, tmp_path / "out")
    assert names_in(tmp_path) == ["a.tar"]


def test_header_size_and_number_of_files_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.tar"
    info = tarfile.TarInfo("././@PaxHeader")
    info.type, info.size = tarfile.XHDTYPE, 1 << 30
    path.write_bytes(tarfile.TarInfo("a").tobuf() + info.tobuf() + bytes(1024))
    with pytest.raises(InputError, match="a header of 1073741824 bytes"):
        extract_tar(path, tmp_path / "out")
    monkeypatch.setattr("v3d_torch.io.extract._MAX_MEMBERS", 2)
    extract_tar(write_archive(tmp_path / "2.tgz", file_member("seq/a"), file_member("seq/b")), tmp_path / "two")
    with pytest.raises(InputError, match="more than 2 files"):
        extract_tar(
            write_archive(tmp_path / "3.tgz", file_member("a"), file_member("b"), file_member("c")), tmp_path / "three"
        )


def test_existing_folder_is_an_output_error(tmp_path: Path) -> None:
    archive = write_archive(tmp_path / "a.tgz", file_member("seq/a"))
    (tmp_path / "out").mkdir()
    with pytest.raises(OutputError, match="already exists"):
        extract_tar(archive, tmp_path / "out")
