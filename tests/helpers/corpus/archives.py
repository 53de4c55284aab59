"""Damaged archives of downloaded sequences. The archives are created here, nothing is downloaded."""

from __future__ import annotations

import gzip
import io
import shutil
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from helpers.corpus.case import Case, Damage, Fails, Succeeds, Workspace, add_options, all_of, first_half, set_sequence

NAME = "rgbd_dataset_freiburg3_walking_xyz"
SEQ = all_of(set_sequence("fr3/w/xyz"), add_options("--data-root", "{root}/data"))


@contextmanager
def served(place: Workspace) -> Iterator[None]:
    """Replace the download by a copy of the archive."""

    def fetch(url: str, target: Path, **_: object) -> Path:
        assert url.endswith(f"/{NAME}.tgz")
        target.parent.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copy(place.root / "archive.tgz", target))

    with patch("v3d_torch.datasets.locate.fetch", fetch):
        yield


def archive(add: Callable[[tarfile.TarFile], None] | None = None, kind: str = "w:gz") -> Damage:
    """Pack the sequence into an archive, with an optional extra member."""

    def make(place: Workspace) -> None:
        with tarfile.open(place.root / "archive.tgz", kind) as tar:
            tar.add(place.folder, NAME)
            if add is not None:
                add(tar)
        SEQ(place)

    return make


def member(name: str, kind: bytes = tarfile.REGTYPE, to: str = "", size: int = 0) -> Callable[[tarfile.TarFile], None]:
    """Add a member of any kind."""

    def add(tar: tarfile.TarFile) -> None:
        info = tarfile.TarInfo(name)
        info.type, info.linkname, info.size = kind, to, size
        tar.addfile(info, io.BytesIO(bytes(min(size, 100))) if size else None)

    return add


def claims(size: int) -> Callable[[tarfile.TarFile], None]:
    """Add the header of a member of this size, without its content."""

    def add(tar: tarfile.TarFile) -> None:
        info = tarfile.TarInfo(f"{NAME}/large.bin")
        info.size = size
        tar.fileobj.write(info.tobuf())  # type: ignore[union-attr]

    return add


def long_name(size: int) -> Callable[[tarfile.TarFile], None]:
    """Add an extended header of this size; its zeros compress to almost nothing."""

    def add(tar: tarfile.TarFile) -> None:
        info = tarfile.TarInfo("././@PaxHeader")
        info.type, info.size = tarfile.XHDTYPE, size
        tar.fileobj.write(info.tobuf())  # type: ignore[union-attr]
        for _ in range(size >> 20):
            tar.fileobj.write(bytes(1 << 20))  # type: ignore[union-attr]

    return add


def changed(change: Callable[[bytes], bytes]) -> Damage:
    """Change the bytes of the archive."""

    def make(place: Workspace) -> None:
        path = place.root / "archive.tgz"
        path.write_bytes(change(path.read_bytes()))

    return make


def flip_byte(content: bytes) -> bytes:
    """Invert the byte in the middle."""
    at = len(content) // 2
    return content[:at] + bytes([content[at] ^ 255]) + content[at + 1 :]


def content_of(content: bytes) -> Damage:
    """Write an archive with this content."""
    return all_of(lambda place: (place.root / "archive.tgz").write_bytes(content), SEQ)  # type: ignore[arg-type, return-value]


UNSAFE = (
    "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, a member leads outside or is not a"
    " plain file (...); get it from another source"
)
NO_SEQUENCE = (
    "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: contains no rgb.txt and depth.txt; get the"
    " archive from another source"
)
INCOMPLETE = (
    "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (...); download it again"
)

CASES = [
    Case(name, make, ends, served)
    for name, make, ends in (
        ("gzip", archive(), Succeeds()),
        ("bzip2", archive(kind="w:bz2"), Succeeds()),
        ("xz", archive(kind="w:xz"), Succeeds()),
        (
            "file outside the folder, by ..",
            archive(member("../outside.txt")),
            Fails(UNSAFE),
        ),
        (
            "file outside the folder, by an absolute path",
            archive(member("/outside.txt", size=3)),
            Fails(NO_SEQUENCE),
        ),
        (
            "symlink to outside the folder",
            archive(member(f"{NAME}/masks", tarfile.SYMTYPE, "../../..")),
            Fails(UNSAFE),
        ),
        (
            "symlink to an absolute path",
            archive(member(f"{NAME}/masks", tarfile.SYMTYPE, "/etc")),
            Fails(UNSAFE),
        ),
        (
            "hard link to outside the folder",
            archive(member(f"{NAME}/x", tarfile.LNKTYPE, "../../etc/passwd")),
            Fails(UNSAFE),
        ),
        (
            "device file",
            archive(member(f"{NAME}/zero", tarfile.CHRTYPE)),
            Fails(UNSAFE),
        ),
        (
            "named pipe",
            archive(member(f"{NAME}/rgb.pipe", tarfile.FIFOTYPE)),
            Fails(UNSAFE),
        ),
        (
            "member with a size of a petabyte",
            archive(claims(10**15)),
            Fails(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is unsafe, it extracts to more than"
                " 21474836480 bytes; get it from another source"
            ),
        ),
        (
            "header of 64 megabytes",
            archive(long_name(1 << 26)),
            Fails(
                "{root}/data/rgbd_dataset_freiburg3_walking_xyz.tgz: is not a complete tar archive (a header of"
                " 67108864 bytes); download it again"
            ),
        ),
        (
            "truncated gzip",
            all_of(archive(), changed(first_half)),
            Fails(INCOMPLETE),
        ),
        (
            "truncated xz",
            all_of(archive(kind="w:xz"), changed(first_half)),
            Fails(INCOMPLETE),
        ),
        (
            "truncated bzip2",
            all_of(archive(kind="w:bz2"), changed(first_half)),
            Fails(INCOMPLETE),
        ),
        (
            "wrong byte in gzip",
            all_of(archive(), changed(flip_byte)),
            Fails(INCOMPLETE),
        ),
        (
            "wrong byte in xz",
            all_of(archive(kind="w:xz"), changed(flip_byte)),
            Fails(INCOMPLETE),
        ),
        (
            "wrong byte in bzip2",
            all_of(archive(kind="w:bz2"), changed(flip_byte)),
            Fails(INCOMPLETE),
        ),
        (
            "empty file",
            content_of(b""),
            Fails(INCOMPLETE),
        ),
        (
            "web page",
            content_of(b"<html>404</html>" * 100),
            Fails(INCOMPLETE),
        ),
        (
            "gzip of an empty file",
            content_of(gzip.compress(b"")),
            Fails(INCOMPLETE),
        ),
        (
            "archive without a sequence",
            all_of(lambda p: shutil.rmtree(p.folder), lambda p: p.folder.mkdir(), archive()),
            Fails(NO_SEQUENCE),
        ),
    )
]
