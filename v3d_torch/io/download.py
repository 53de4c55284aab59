"""Downloads that resume, are checked and arrive whole or not at all."""

from __future__ import annotations

import hashlib
import http.client
import os
import re
import urllib.error
import urllib.request
from collections.abc import Callable
from email.message import Message
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from platformdirs import user_cache_path

from v3d_torch.errors import DownloadError, OutputError
from v3d_torch.io.paths import expand_user

Progress = Callable[[int, int | None], None]
"""Called with the bytes that are here and the bytes that there will be (None: the server does not say)."""

_CHUNK = 1 << 18
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


def cache_dir() -> Path:
    """Folder for what is downloaded or made once: ``$V3D_CACHE``, else the user's cache of this platform."""
    return expand_user(os.environ.get("V3D_CACHE") or user_cache_path("v3d_torch"))


def fetch(
    url: str,
    target: Path,
    *,
    sha256: str | None = None,
    size: int | None = None,
    progress: Progress | None = None,
    timeout: float = 5.0,
) -> Path:
    """Download ``url`` to ``target``, replacing it only when everything has arrived and is right.

    Bytes gather in ``target`` + ``.part``; when a download breaks off, the next one goes on from there.

    Args:
        url: https; plain http is allowed for the own machine only. Redirects are followed to https only.
        target: file to write; missing parent folders are made.
        sha256: hexadecimal checksum that the file must have.
        size: bytes that the file must have; what the server announces is checked in any case.
        progress: told after every chunk.
        timeout: longest wait for the connection and for each chunk, seconds.

    Returns:
        ``target``.

    Raises:
        DownloadError: no network, an answer other than the file, a connection that breaks off, wrong size or checksum.
        OutputError: the file cannot be written.
    """
    parts = urlsplit(url)
    if parts.scheme != "https" and not (parts.scheme == "http" and parts.hostname in _LOOPBACK):
        raise DownloadError(f"{url}: only https addresses are downloaded")
    part = target.with_name(f"{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _complete(url, part, size, progress, timeout)
        _check(url, part, sha256, size)
        part.replace(target)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error}); choose another folder") from error
    return target


def _complete(url: str, part: Path, size: int | None, progress: Progress | None, timeout: float) -> None:
    """Bring ``part`` to its full length, from where it stands if the server can."""
    done = part.stat().st_size if part.exists() else 0
    try:
        response = _open(url, done, timeout)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not done:
            raise DownloadError(f"{url}: the server answers {error.code} {error.reason}") from error
        if _whole(error.headers) == done:
            return
        part.unlink()
        _complete(url, part, size, progress, timeout)
        return
    except (OSError, http.client.HTTPException) as error:
        raise DownloadError(f"{url}: cannot be reached ({_reason(error)})") from error
    with response:
        if response.status != 206:
            done = 0
        total = _whole(response.headers) if done else _length(response.headers)
        if size is not None and total not in (size, None):
            part.unlink(missing_ok=True)
            raise DownloadError(f"{url}: the server offers {total} bytes where {size} are expected")
        with part.open("ab" if done else "wb") as file:
            while chunk := _read(response, url):
                file.write(chunk)
                done += len(chunk)
                if progress is not None:
                    progress(done, total if total is not None else size)
    if total is not None and done < total:
        raise DownloadError(
            f"{url}: the connection broke off after {done} of {total} bytes; try again to go on from there"
        )


def _open(url: str, start: int, timeout: float) -> http.client.HTTPResponse:
    headers = {"User-Agent": "v3d_torch"} | ({"Range": f"bytes={start}-"} if start else {})
    opener = urllib.request.build_opener(_HttpsRedirects)
    request = urllib.request.Request(url, headers=headers)  # noqa: S310 - `fetch` lets nothing but https through
    response: http.client.HTTPResponse = opener.open(request, timeout=timeout)
    return response


def _read(response: http.client.HTTPResponse, url: str) -> bytes:
    try:
        return response.read(_CHUNK)
    except (OSError, http.client.HTTPException) as error:
        raise DownloadError(f"{url}: the connection broke off ({_reason(error)}); try again to go on") from error


def _whole(headers: Message) -> int | None:
    """Length of the whole file, from an answer to a request for a part of it."""
    match = re.fullmatch(r"bytes (?:\d+-\d+|\*)/(\d+)", headers.get("Content-Range", "").strip())
    return int(match[1]) if match else None


def _length(headers: Message) -> int | None:
    """Length of the answer."""
    length = headers.get("Content-Length", "")
    return int(length) if length.isdigit() else None


def _check(url: str, part: Path, sha256: str | None, size: int | None) -> None:
    """Refuse, and remove, a file that is not what it should be: going on from it would never help."""
    actual_size = part.stat().st_size
    if size is not None and actual_size != size:
        part.unlink()
        raise DownloadError(f"{url}: {actual_size} bytes arrived where {size} are expected")
    if sha256 is None:
        return
    with part.open("rb") as file:
        actual = hashlib.file_digest(file, "sha256").hexdigest()
    if actual != sha256.lower():
        part.unlink()
        raise DownloadError(f"{url}: the file that arrived has the sha256 {actual}, expected is {sha256}")


def _reason(error: BaseException) -> str:
    """The cause in a few words, without urllib's wrapping."""
    cause = getattr(error, "reason", error)
    return str(getattr(cause, "strerror", None) or cause or type(error).__name__)


class _HttpsRedirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to https and refuses all others."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Message, newurl: str
    ) -> urllib.request.Request | None:
        if not newurl.startswith("https://"):
            raise DownloadError(f"{req.full_url}: the server redirects to {newurl}, which is not https")
        return super().redirect_request(req, fp, code, msg, headers, newurl)  # type: ignore[arg-type]
