"""Archives of sequences that are downloaded: they are made here, and nothing is fetched."""

from __future__ import annotations

import gzip
import io
import shutil
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from helpers.corpus.case import Case, Make, Place, Right, Says, all_of, half, options, seq

NAME = "rgbd_dataset_freiburg3_walking_xyz"
SEQ = all_of(seq("fr3/w/xyz"), options("--data-root", "{root}/data"))


@contextmanager
def served(place: Place) -> Iterator[None]:
    """The archive comes as if it had been downloaded."""

    def fetch(url: str, target: Path, **_: object) -> Path:
        assert url.endswith(f"/{NAME}.tgz")
        target.parent.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copy(place.root / "archive.tgz", target))

    with patch("v3d_torch.datasets.locate.fetch", fetch):
        yield


def archive(add: Callable[[tarfile.TarFile], None] | None = None, kind: str = "w:gz") -> Make:
    """The sequence in an archive, with more in it."""

    def make(place: Place) -> None:
        with tarfile.open(place.root / "archive.tgz", kind) as tar:
            tar.add(place.folder, NAME)
            if add is not None:
                add(tar)
        SEQ(place)

    return make


def member(name: str, kind: bytes = tarfile.REGTYPE, to: str = "", size: int = 0) -> Callable[[tarfile.TarFile], None]:
    def add(tar: tarfile.TarFile) -> None:
        info = tarfile.TarInfo(name)
        info.type, info.linkname, info.size = kind, to, size
        tar.addfile(info, io.BytesIO(bytes(min(size, 100))) if size else None)

    return add


def claims(size: int) -> Callable[[tarfile.TarFile], None]:
    """A member that says to be so large, of which nothing is there."""

    def add(tar: tarfile.TarFile) -> None:
        info = tarfile.TarInfo(f"{NAME}/large.bin")
        info.size = size
        tar.fileobj.write(info.tobuf())  # type: ignore[union-attr]

    return add


def long_name(size: int) -> Callable[[tarfile.TarFile], None]:
    """A header whose name is so long, of zeros, which are small in the archive."""

    def add(tar: tarfile.TarFile) -> None:
        info = tarfile.TarInfo("././@PaxHeader")
        info.type, info.size = tarfile.XHDTYPE, size
        tar.fileobj.write(info.tobuf())  # type: ignore[union-attr]
        for _ in range(size >> 20):
            tar.fileobj.write(bytes(1 << 20))  # type: ignore[union-attr]

    return add


def changed(change: Callable[[bytes], bytes]) -> Make:
    def make(place: Place) -> None:
        path = place.root / "archive.tgz"
        path.write_bytes(change(path.read_bytes()))

    return make


def flipped(content: bytes) -> bytes:
    at = len(content) // 2
    return content[:at] + bytes([content[at] ^ 255]) + content[at + 1 :]


def text(content: bytes) -> Make:
    return all_of(lambda place: (place.root / "archive.tgz").write_bytes(content), SEQ)  # type: ignore[arg-type, return-value]


CASES = [
    Case(name, make, ends, served)
    for name, make, ends in (
        ("whole", archive(), Right()),
        ("bzip2", archive(kind="w:bz2"), Right()),
        ("xz", archive(kind="w:xz"), Right()),
        (
            "a file outside by ..",
            archive(member("../outside.txt")),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, a member leads outside or is"
                " not a plain file (...); get it from another source"
            ),
        ),
        (
            "a file outside by an absolute path",
            archive(member("/outside.txt", size=3)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: holds no rgb.txt and depth.txt; get the"
                " archive from another source"
            ),
        ),
        (
            "a link outside",
            archive(member(f"{NAME}/masks", tarfile.SYMTYPE, "../../..")),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, a member leads outside or is"
                " not a plain file (...); get it from another source"
            ),
        ),
        (
            "a link to an absolute path",
            archive(member(f"{NAME}/masks", tarfile.SYMTYPE, "/etc")),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, a member leads outside or is"
                " not a plain file (...); get it from another source"
            ),
        ),
        (
            "a hard link outside",
            archive(member(f"{NAME}/x", tarfile.LNKTYPE, "../../etc/passwd")),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, a member leads outside or is"
                " not a plain file (...); get it from another source"
            ),
        ),
        (
            "a device",
            archive(member(f"{NAME}/zero", tarfile.CHRTYPE)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, a member leads outside or is"
                " not a plain file (...); get it from another source"
            ),
        ),
        (
            "a pipe",
            archive(member(f"{NAME}/rgb.pipe", tarfile.FIFOTYPE)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, a member leads outside or is"
                " not a plain file (...); get it from another source"
            ),
        ),
        (
            "a member of a petabyte",
            archive(claims(10**15)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, it extracts to more than"
                " 21474836480 bytes; get it from another source"
            ),
        ),
        (
            "a header of 64 megabytes",
            archive(long_name(1 << 26)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (a header of"
                " 67108864 bytes); download it again"
            ),
        ),
        (
            "breaks off",
            all_of(archive(), changed(half)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "xz breaks off",
            all_of(archive(kind="w:xz"), changed(half)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "bzip2 breaks off",
            all_of(archive(kind="w:bz2"), changed(half)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "a wrong byte",
            all_of(archive(), changed(flipped)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "a wrong byte in xz",
            all_of(archive(kind="w:xz"), changed(flipped)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "a wrong byte in bzip2",
            all_of(archive(kind="w:bz2"), changed(flipped)),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "empty",
            text(b""),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "a web page",
            text(b"<html>404</html>" * 100),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "gzip of nothing",
            text(gzip.compress(b"")),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download"
                " it again"
            ),
        ),
        (
            "without a sequence",
            all_of(lambda p: shutil.rmtree(p.folder), lambda p: p.folder.mkdir(), archive()),
            Says(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: holds no rgb.txt and depth.txt; get the"
                " archive from another source"
            ),
        ),
    )
]
