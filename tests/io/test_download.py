"""Downloads from a server on this machine: resuming, verification and rejected addresses."""

from __future__ import annotations

import hashlib
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import ClassVar

import pytest
from helpers.folders import names_in
from helpers.http_server import running_server

from v3d_torch.errors import DownloadError, OutputError
from v3d_torch.io.download import fetch

CONTENT = bytes(range(256)) * 4000  # about a megabyte: several chunks
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Handler(BaseHTTPRequestHandler):
    """Serves CONTENT in the way that the path says, and records the requests."""

    requests: ClassVar[list[tuple[str, str | None]]] = []
    ended: ClassVar[threading.Event] = threading.Event()
    """Whether the test has ended, for which the path ``/stalled`` waits."""

    def do_GET(self) -> None:
        byte_range = self.headers.get("Range")
        self.requests.append((self.path, byte_range))
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
            self.ended.wait()
        elif self.path == "/ranged" and byte_range:
            start = int(byte_range.removeprefix("bytes=").removesuffix("-"))
            if start >= len(CONTENT):
                self._answer(416, b"", **{"Content-Range": f"bytes */{len(CONTENT)}"})
            else:
                span = f"bytes {start}-{len(CONTENT) - 1}/{len(CONTENT)}"
                self._answer(206, CONTENT[start:], **{"Content-Range": span})
        elif self.path == "/wrong_range" and byte_range:
            self._answer(206, CONTENT, **{"Content-Range": f"bytes 0-{len(CONTENT) - 1}/{len(CONTENT)}"})
        elif self.path == "/login":
            self._answer(200, b"<html>log in</html>", **{"Content-Type": "text/html; charset=utf-8"})
        elif self.path == "/no_address":
            self._answer(302, b"", Location="https://[bad")
        elif self.path == "/mute416" and byte_range:
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
    Handler.ended.clear()
    with running_server(Handler) as address:
        yield address
        Handler.ended.set()


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "new" / "file.bin"


def write_part(target: Path, content: bytes) -> Path:
    part = target.with_name("file.bin.part")
    part.parent.mkdir(parents=True, exist_ok=True)
    part.write_bytes(content)
    return part


@pytest.mark.parametrize("path", ["/ranged", "/plain", "/unsized"])
def test_download_is_verified_and_reports_progress(server: str, target: Path, path: str) -> None:
    reports: list[tuple[int, int | None]] = []
    result = fetch(
        server + path, target, sha256=SHA256, size=len(CONTENT), progress=lambda *state: reports.append(state)
    )
    assert result == target
    assert target.read_bytes() == CONTENT
    assert names_in(target.parent) == ["file.bin"]
    assert reports[-1] == (len(CONTENT), len(CONTENT))
    assert [done for done, _ in reports] == sorted({done for done, _ in reports})


def test_interrupted_download_resumes(server: str, target: Path) -> None:
    write_part(target, CONTENT[:300_001])
    reports: list[int] = []
    fetch(f"{server}/ranged", target, sha256=SHA256, progress=lambda done, total: reports.append(done))
    assert Handler.requests == [("/ranged", "bytes=300001-")]
    assert reports[0] > 300_001
    assert target.read_bytes() == CONTENT


def test_checksum_can_be_given_in_capital_letters(server: str, target: Path) -> None:
    fetch(f"{server}/plain", target, sha256=SHA256.upper())
    assert target.read_bytes() == CONTENT


def test_download_restarts_if_the_server_has_no_ranges(server: str, target: Path) -> None:
    write_part(target, b"other bytes")
    fetch(f"{server}/plain", target, sha256=SHA256)
    assert Handler.requests == [("/plain", "bytes=11-")]


def test_complete_part_is_accepted_without_another_download(server: str, target: Path) -> None:
    write_part(target, CONTENT)
    fetch(f"{server}/ranged", target, sha256=SHA256)
    assert len(Handler.requests) == 1


@pytest.mark.parametrize(
    ("path", "part"),
    [("/ranged", CONTENT + b"too much"), ("/mute416", CONTENT[:500])],
    ids=["longer", "416 without length"],
)
def test_download_restarts_if_the_part_cannot_be_completed(server: str, target: Path, path: str, part: bytes) -> None:
    write_part(target, part)
    fetch(server + path, target)
    assert target.read_bytes() == CONTENT
    assert len(Handler.requests) == 2


def test_lost_connection_keeps_the_part_but_no_target(server: str, target: Path) -> None:
    with pytest.raises(
        DownloadError, match=f"connection was lost after {len(CONTENT) // 2} of {len(CONTENT)} bytes; try again"
    ):
        fetch(f"{server}/broken", target)
    assert not target.exists()
    fetch(f"{server}/ranged", target, sha256=SHA256)
    assert Handler.requests[-1] == ("/ranged", f"bytes={len(CONTENT) // 2}-")


def test_stalled_connection_times_out(server: str, target: Path) -> None:
    with pytest.raises(DownloadError, match=r"connection was lost .*timed out"):
        fetch(f"{server}/stalled", target, timeout=0.3)


@pytest.mark.parametrize(
    ("path", "check", "message"),
    [
        ("/plain", {"sha256": "0" * 64}, SHA256),
        ("/plain", {"size": 5}, "offers 1024000 bytes, expected 5"),
        ("/unsized", {"size": 5}, "1024000 bytes were received, expected 5"),
    ],
)
def test_file_of_wrong_size_or_checksum_is_removed(
    server: str, target: Path, path: str, check: dict[str, object], message: str
) -> None:
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
def test_http_errors_and_insecure_redirects_are_errors(server: str, target: Path, path: str, message: str) -> None:
    with pytest.raises(DownloadError, match=message):
        fetch(server + path, target)
    assert not target.exists()


@pytest.mark.parametrize("url", ["http://example.org/a", "ftp://example.org/a", "file:///etc/passwd", "a"])
def test_only_https_is_accepted(target: Path, url: str) -> None:
    with pytest.raises(DownloadError, match="only https addresses"):
        fetch(url, target)


def test_refused_connection_is_an_error(target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "*")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(DownloadError, match=r"cannot be reached .*refused"):
        fetch(f"http://127.0.0.1:{port}/file", target)


def test_unwritable_folder_is_an_output_error(server: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OutputError, match="choose another folder"):
        fetch(f"{server}/plain", tmp_path / "file" / "inside")


def test_answer_with_another_range_is_not_appended(server: str, target: Path) -> None:
    write_part(target, CONTENT[:1000])
    assert fetch(f"{server}/wrong_range", target, sha256=SHA256).read_bytes() == CONTENT


def test_web_page_in_place_of_the_file_does_not_replace_the_part(server: str, target: Path) -> None:
    part = write_part(target, CONTENT[:1000])
    with pytest.raises(DownloadError, match="the server answers with a web page; log in to the network"):
        fetch(f"{server}/login", target)
    assert part.read_bytes() == CONTENT[:1000] and not target.exists()


def test_redirect_to_no_address_is_an_error(server: str, target: Path) -> None:
    with pytest.raises(DownloadError, match=r"no_address: cannot be reached \("):
        fetch(f"{server}/no_address", target)
