"""Downloads over https: resumed after an interruption, verified, and atomic."""

from __future__ import annotations

import hashlib
import http.client
import re
import urllib.error
import urllib.request
from collections.abc import Callable
from email.message import Message
from pathlib import Path
from typing import IO
from urllib.parse import urlsplit

from v3d_torch.errors import DownloadError, OutputError

Progress = Callable[[int, int | None], None]
"""Called with the amount done and the total amount (None if unknown), both in bytes for downloads."""

_CHUNK_SIZE = 1 << 18
_LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "::1")


def fetch(
    url: str,
    target: Path,
    *,
    sha256: str | None = None,
    size: int | None = None,
    progress: Progress | None = None,
    timeout: float = 5.0,
) -> Path:
    """Download ``url`` to ``target``; an existing ``target`` is replaced only after the download is verified.

    Data is collected in ``target`` + ``.part``, from which an interrupted download resumes.

    Args:
        url: Address with https, or with http on the local machine. Only redirects to https are followed.
        target: File to write; missing parent folders are created.
        sha256: Expected checksum, hexadecimal.
        size: Expected size, bytes; the size that the server announces is checked in any case.
        progress: Called after every chunk.
        timeout: Maximum wait for the connection and for each chunk, seconds.

    Returns:
        ``target``.

    Raises:
        DownloadError: If the server cannot be reached, does not return the file, or the connection is lost; or if the
            size or checksum is wrong.
        OutputError: If the file cannot be written.
    """
    address = urlsplit(url)
    if address.scheme != "https" and not (address.scheme == "http" and address.hostname in _LOOPBACK_HOSTS):
        raise DownloadError(f"{url}: only https addresses can be downloaded")
    part = target.with_name(f"{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _complete_part(url, part, size, progress, timeout)
        _verify_part(url, part, sha256, size)
        part.replace(target)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error}); choose another folder") from error
    return target


def _complete_part(url: str, part: Path, size: int | None, progress: Progress | None, timeout: float) -> None:
    """Download the rest of ``part``, or all of it if the server cannot resume."""
    done = part.stat().st_size if part.exists() else 0
    try:
        response = _open(url, done, timeout)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not done:
            raise DownloadError(f"{url}: the server answers {error.code} {error.reason}") from error
        # 416: no bytes after `done`. The part is complete, or longer than the file.
        if _total_length(error.headers) == done:
            return
        part.unlink()
        _complete_part(url, part, size, progress, timeout)
        return
    except (OSError, http.client.HTTPException, ValueError) as error:  # a ValueError if a redirect is no address
        raise DownloadError(f"{url}: cannot be reached ({_cause(error)})") from error
    with response:
        if response.headers.get_content_type() == "text/html":  # would replace what was received before
            raise DownloadError(f"{url}: the server answers with a web page; log in to the network, or try again later")
        if done and response.status == 206 and _range_start(response.headers) != done:
            part.unlink()
            _complete_part(url, part, size, progress, timeout)
            return
        if response.status != 206:  # not partial content: the server sends the file from its start
            done = 0
        total = _total_length(response.headers) if done else _content_length(response.headers)
        if size is not None and total not in (size, None):
            part.unlink(missing_ok=True)
            raise DownloadError(f"{url}: the server offers {total} bytes, expected {size}")
        with part.open("ab" if done else "wb") as file:
            while chunk := _read_chunk(response, url):
                file.write(chunk)
                done += len(chunk)
                if progress is not None:
                    progress(done, total if total is not None else size)
    if total is not None and done < total:
        raise DownloadError(f"{url}: the connection was lost after {done} of {total} bytes; try again to resume")


def _open(url: str, start: int, timeout: float) -> http.client.HTTPResponse:
    headers = {"User-Agent": "v3d_torch"} | ({"Range": f"bytes={start}-"} if start else {})
    opener = urllib.request.build_opener(_HttpsRedirects)
    request = urllib.request.Request(url, headers=headers)  # noqa: S310 - `fetch` accepts only https
    response: http.client.HTTPResponse = opener.open(request, timeout=timeout)
    return response


def _read_chunk(response: http.client.HTTPResponse, url: str) -> bytes:
    try:
        return response.read(_CHUNK_SIZE)
    except (OSError, http.client.HTTPException) as error:
        raise DownloadError(f"{url}: the connection was lost ({_cause(error)}); try again to resume") from error


def _total_length(headers: Message) -> int | None:
    """Length of the whole file, from the response to a range request."""
    match = re.fullmatch(r"bytes (?:\d+-\d+|\*)/(\d+)", headers.get("Content-Range", "").strip())
    return int(match[1]) if match else None


def _range_start(headers: Message) -> int | None:
    """Position of the first byte of the response to a range request."""
    match = re.match(r"bytes (\d+)-", headers.get("Content-Range", "").strip())
    return int(match[1]) if match else None


def _content_length(headers: Message) -> int | None:
    length = headers.get("Content-Length", "")
    return int(length) if length.isdigit() else None


def _verify_part(url: str, part: Path, sha256: str | None, size: int | None) -> None:
    """Raise DownloadError and remove the part if its size or checksum is wrong, because resuming cannot repair it."""
    actual_size = part.stat().st_size
    if size is not None and actual_size != size:
        part.unlink()
        raise DownloadError(f"{url}: {actual_size} bytes were received, expected {size}")
    if sha256 is None:
        return
    with part.open("rb") as file:
        actual = hashlib.file_digest(file, "sha256").hexdigest()
    if actual != sha256.lower():
        part.unlink()
        raise DownloadError(f"{url}: the downloaded file has sha256 {actual}, expected {sha256}")


def _cause(error: BaseException) -> str:
    """Short cause of an error, without the text that urllib adds."""
    cause = getattr(error, "reason", error)
    return " ".join(str(getattr(cause, "strerror", None) or cause or type(error).__name__).split())


class _HttpsRedirects(urllib.request.HTTPRedirectHandler):
    """Redirect handler that rejects redirects to anything but https."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Message, newurl: str
    ) -> urllib.request.Request | None:
        if not newurl.startswith("https://"):
            raise DownloadError(f"{req.full_url}: the server redirects to {newurl}, which is not https")
        return super().redirect_request(req, fp, code, msg, headers, newurl)  # type: ignore[arg-type]
