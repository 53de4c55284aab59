"""Downloads against a server on this machine: resuming, checks, refusals; and archives that mean harm."""

from __future__ import annotations

import hashlib
import io
import os
import socket
import tarfile
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest

from v3d_torch.errors import DownloadError, InputError, OutputError
from v3d_torch.io.download import cache_dir, fetch
from v3d_torch.io.extract import extract_tar

CONTENT = bytes(range(256)) * 4000  # about a megabyte: several chunks
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Handler(BaseHTTPRequestHandler):
    """Serves CONTENT in the way that the path asks for, and notes what was asked."""

    requests: ClassVar[list[tuple[str, str | None]]] = []

    def do_GET(self) -> None:
        wanted = self.headers.get("Range")
        self.requests.append((self.path, wanted))
        if self.path == "/redirect":
            self._answer(302, b"", Location="http://example.org/file")
        elif self.path == "/missing":
            self._answer(404, b"no such file")
        elif self.path == "/never":
            self._answer(416, b"")
        elif self.path == "/unsized":
            self.send_response(200)
            self.end_headers()
            self.wfile.write(CONTENT)
        elif self.path == "/broken":
            self._answer(200, CONTENT[: len(CONTENT) // 2], length=len(CONTENT))
        elif self.path == "/stalled":
            self._answer(200, CONTENT[:1000], length=len(CONTENT))
            time.sleep(1.5)
        elif self.path == "/ranged" and wanted:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
            if start >= len(CONTENT):
                self._answer(416, b"", **{"Content-Range": f"bytes */{len(CONTENT)}"})
            else:
                span = f"bytes {start}-{len(CONTENT) - 1}/{len(CONTENT)}"
                self._answer(206, CONTENT[start:], **{"Content-Range": span})
        elif self.path == "/mute416" and wanted:
            self._answer(416, b"")
        else:
            self._answer(200, CONTENT)

    def _answer(self, status: int, body: bytes, length: int | None = None, **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        for key, value in headers.items():
            self.send_header(key, value)
        self.end_headers()
        self.wfile.write(body)
        self.wfile.flush()

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv("no_proxy", "*")
    Handler.requests.clear()
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=httpd.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_address[1]}"
    httpd.shutdown()
    httpd.server_close()
    thread.join()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "new" / "file.bin"


def names_in(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def part_of(target: Path, content: bytes) -> Path:
    part = target.with_name("file.bin.part")
    part.parent.mkdir(parents=True, exist_ok=True)
    part.write_bytes(content)
    return part


@pytest.mark.parametrize("path", ["/ranged", "/plain", "/unsized"])
def test_whole_file_with_progress(server: str, target: Path, path: str) -> None:
    seen: list[tuple[int, int | None]] = []
    result = fetch(server + path, target, sha256=SHA256, size=len(CONTENT), progress=lambda *state: seen.append(state))
    assert result == target
    assert target.read_bytes() == CONTENT
    assert names_in(target.parent) == ["file.bin"]
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert [done for done, _ in seen] == sorted({done for done, _ in seen})


def test_resumes_where_it_stopped(server: str, target: Path) -> None:
    part_of(target, CONTENT[:300_001])
    seen: list[int] = []
    fetch(f"{server}/ranged", target, sha256=SHA256, progress=lambda done, total: seen.append(done))
    assert Handler.requests == [("/ranged", "bytes=300001-")]
    assert seen[0] > 300_001
    assert target.read_bytes() == CONTENT


def test_starts_over_where_the_server_has_no_ranges(server: str, target: Path) -> None:
    part_of(target, b"other bytes")
    fetch(f"{server}/plain", target, sha256=SHA256)
    assert Handler.requests == [("/plain", "bytes=11-")]


def test_takes_a_part_that_is_already_whole(server: str, target: Path) -> None:
    part_of(target, CONTENT)
    fetch(f"{server}/ranged", target, sha256=SHA256)
    assert len(Handler.requests) == 1


@pytest.mark.parametrize(
    ("path", "rest"), [("/ranged", CONTENT + b"too much"), ("/mute416", CONTENT[:500])], ids=["longer", "silent 416"]
)
def test_starts_over_where_the_part_does_not_fit(server: str, target: Path, path: str, rest: bytes) -> None:
    part_of(target, rest)
    fetch(server + path, target)
    assert target.read_bytes() == CONTENT
    assert len(Handler.requests) == 2


def test_a_broken_download_keeps_its_part_and_not_the_target(server: str, target: Path) -> None:
    with pytest.raises(DownloadError, match=f"after {len(CONTENT) // 2} of {len(CONTENT)} bytes"):
        fetch(f"{server}/broken", target)
    assert not target.exists()
    fetch(f"{server}/ranged", target, sha256=SHA256)
    assert Handler.requests[-1] == ("/ranged", f"bytes={len(CONTENT) // 2}-")


def test_a_stalled_connection_times_out(server: str, target: Path) -> None:
    start = time.monotonic()
    with pytest.raises(DownloadError, match=r"broke off .*timed out"):
        fetch(f"{server}/stalled", target, timeout=0.3)
    assert time.monotonic() - start < 4  # the usual is 5


@pytest.mark.parametrize(
    ("path", "check", "message"),
    [
        ("/plain", {"sha256": "0" * 64}, SHA256),
        ("/plain", {"size": 5}, "offers 1024000 bytes where 5"),
        ("/unsized", {"size": 5}, "1024000 bytes arrived where 5"),
    ],
)
def test_a_wrong_file_is_removed(server: str, target: Path, path: str, check: dict[str, object], message: str) -> None:
    target.parent.mkdir()
    target.write_bytes(b"the old file")
    with pytest.raises(DownloadError, match=message):
        fetch(server + path, target, **check)
    assert names_in(target.parent) == ["file.bin"]
    assert target.read_bytes() == b"the old file"


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("/missing", "answers 404"),
        ("/never", "answers 416"),
        ("/redirect", "http://example.org/file, which is not https"),
    ],
)
def test_other_answers_are_errors(server: str, target: Path, path: str, message: str) -> None:
    with pytest.raises(DownloadError, match=message):
        fetch(server + path, target)
    assert not target.exists()


@pytest.mark.parametrize("url", ["http://example.org/a", "ftp://example.org/a", "file:///etc/passwd", "a"])
def test_only_https(target: Path, url: str) -> None:
    with pytest.raises(DownloadError, match="only https"):
        fetch(url, target)


def test_refused_connection_fails_at_once(target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "*")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    start = time.monotonic()
    with pytest.raises(DownloadError, match=r"cannot be reached .*refused"):
        fetch(f"http://127.0.0.1:{port}/file", target)
    assert time.monotonic() - start < 4


def test_a_folder_that_cannot_be_written(server: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OutputError, match="choose another folder"):
        fetch(f"{server}/plain", tmp_path / "file" / "inside")


def test_cache_dir_follows_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("V3D_CACHE", str(tmp_path))
    assert cache_dir() == tmp_path
    monkeypatch.delenv("V3D_CACHE")
    assert cache_dir().name == "v3d_torch"


def archive_of(path: Path, *members: tuple[tarfile.TarInfo, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as tar:
        for info, content in members:
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return path


def a_file(name: str, content: bytes = b"content") -> tuple[tarfile.TarInfo, bytes]:
    return tarfile.TarInfo(name), content


def a_link(name: str, to: str, kind: bytes) -> tuple[tarfile.TarInfo, bytes]:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, to
    return info, b""


@pytest.mark.parametrize("top", ["sequence/", ""])
def test_extract_leaves_out_the_top_folder(tmp_path: Path, top: str) -> None:
    archive = archive_of(tmp_path / "a.tgz", a_file(f"{top}rgb.txt"), a_file(f"{top}rgb/1.png", b"image"))
    extract_tar(archive, tmp_path / "out" / "seq")
    found = sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*"))
    assert found == ["seq", "seq/rgb", "seq/rgb.txt", "seq/rgb/1.png"]
    assert (tmp_path / "out" / "seq" / "rgb" / "1.png").read_bytes() == b"image"


@pytest.mark.parametrize(
    "member",
    [
        a_file("../outside"),
        a_file("seq/../../outside"),
        a_link("seq/link", "../../outside", tarfile.SYMTYPE),
        a_link("seq/link", "/etc/passwd", tarfile.SYMTYPE),
        a_link("seq/link", "../outside", tarfile.LNKTYPE),
        a_link("seq/device", "", tarfile.CHRTYPE),
        a_link("seq/pipe", "", tarfile.FIFOTYPE),
    ],
    ids=["parent", "parent inside", "symbolic link", "absolute link", "hard link", "device", "pipe"],
)
def test_extract_refuses_what_leads_outside(tmp_path: Path, member: tuple[tarfile.TarInfo, bytes]) -> None:
    (tmp_path / "box").mkdir()
    archive = archive_of(tmp_path / "a.tgz", a_file("seq/rgb.txt"), member)
    with pytest.raises(InputError, match="is refused"):
        extract_tar(archive, tmp_path / "box" / "seq")
    assert names_in(tmp_path) == ["a.tgz", "box"]
    assert names_in(tmp_path / "box") == []


def test_extract_puts_absolute_names_inside(tmp_path: Path) -> None:
    archive = archive_of(tmp_path / "a.tgz", a_file("/seq/rgb.txt"))
    extract_tar(archive, tmp_path / "out")
    assert names_in(tmp_path / "out") == ["rgb.txt"]


def test_extract_limits_the_size(tmp_path: Path) -> None:
    archive = archive_of(tmp_path / "a.tgz", a_file("seq/a", bytes(600)), a_file("seq/b", bytes(600)))
    with pytest.raises(InputError, match="more than 1000 bytes"):
        extract_tar(archive, tmp_path / "out", max_bytes=1000)
    assert names_in(tmp_path) == ["a.tgz"]
    extract_tar(archive, tmp_path / "out", max_bytes=1200)


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.999])
def test_extract_refuses_a_truncated_archive(tmp_path: Path, keep: float) -> None:
    archive = archive_of(tmp_path / "a.tgz", a_file("seq/a", os.urandom(50_000)))
    archive.write_bytes(archive.read_bytes()[: int(keep * archive.stat().st_size)])
    with pytest.raises(InputError, match="not a whole tar archive"):
        extract_tar(archive, tmp_path / "out")
    assert names_in(tmp_path) == ["a.tgz"]


@pytest.mark.parametrize("kind", ["gz", "bz2", "xz"])
@pytest.mark.parametrize("where", [0.3, 0.6, 0.999])
def test_extract_refuses_a_wrong_byte(tmp_path: Path, kind: str, where: float) -> None:
    """Also in what is behind the last member, where `tarfile` does not look."""
    path = tmp_path / "a.tgz"
    with tarfile.open(path, f"w:{kind}") as tar:
        info, content = a_file("seq/a", os.urandom(20_000))
        info.size = len(content)
        tar.addfile(info, io.BytesIO(content))
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 0x55
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a whole tar archive"):
        extract_tar(path, tmp_path / "out")
    assert names_in(tmp_path) == ["a.tgz"]


def test_extract_takes_a_broken_header_for_no_end(tmp_path: Path) -> None:
    path = tmp_path / "a.tar"
    with tarfile.open(path, "w:") as tar:
        for name in ("seq/a", "seq/b"):
            tar.addfile(tarfile.TarInfo(name))
    content = bytearray(path.read_bytes())
    content[512 + 10] ^= 0x55  # in the name of the second, which its checksum counts in
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"not a whole tar archive \(.*checksum"):
        extract_tar(path, tmp_path / "out")
    assert names_in(tmp_path) == ["a.tar"]


def test_extract_limits_headers_and_the_number_of_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.tar"
    info = tarfile.TarInfo("././@PaxHeader")
    info.type, info.size = tarfile.XHDTYPE, 1 << 30
    path.write_bytes(tarfile.TarInfo("a").tobuf() + info.tobuf() + bytes(1024))
    with pytest.raises(InputError, match="a header of 1073741824 bytes"):
        extract_tar(path, tmp_path / "out")
    monkeypatch.setattr("v3d_torch.io.extract._MAX_MEMBERS", 2)
    extract_tar(archive_of(tmp_path / "2.tgz", a_file("seq/a"), a_file("seq/b")), tmp_path / "two")
    with pytest.raises(InputError, match="more than 2 files"):
        extract_tar(archive_of(tmp_path / "3.tgz", a_file("a"), a_file("b"), a_file("c")), tmp_path / "three")


def test_extract_never_overwrites(tmp_path: Path) -> None:
    archive = archive_of(tmp_path / "a.tgz", a_file("seq/a"))
    (tmp_path / "out").mkdir()
    with pytest.raises(OutputError, match="already there"):
        extract_tar(archive, tmp_path / "out")
