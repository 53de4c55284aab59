"""Reading of ``.pt`` weights: tensors are returned, no code of the file is executed."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from helpers.unpickled_code import CreatesFile
from torch import nn

from v3d_torch.errors import WeightsError
from v3d_torch.segmentation.pt_weights import read_pt_weights
from v3d_torch.segmentation.weights import sha256_of


@pytest.fixture
def malicious(tmp_path: Path) -> tuple[Path, Path]:
    """File that creates another file when it is loaded without restrictions, and that file."""
    path, created = tmp_path / "malicious.pt", tmp_path / "created"
    torch.save({"model": CreatesFile(created)}, path)
    return path, created


def test_malicious_file_is_effective_without_restrictions(malicious: tuple[Path, Path]) -> None:
    path, created = malicious
    torch.load(path, weights_only=False)
    assert created.is_file()


def test_names_that_are_not_allowed_are_rejected_despite_correct_checksum(malicious: tuple[Path, Path]) -> None:
    path, created = malicious
    with pytest.raises(WeightsError, match=r"malicious\.pt: cannot be read safely"):
        read_pt_weights(path, sha256_of(path))
    assert not created.exists()


@pytest.mark.parametrize(
    "content",
    [
        b"cbuiltins\neval\n(V__import__('os').mkdir('{created}')\ntR.",
        b"cbuiltins\ngetattr\n(cbuiltins\n__import__\nVsystem\ntR.",
        b"not a pickle at all",
        b"",
    ],
)
def test_other_pickles_and_arbitrary_bytes_are_rejected(tmp_path: Path, content: bytes) -> None:
    path, created = tmp_path / "invalid.pt", tmp_path / "created"
    path.write_bytes(content.replace(b"{created}", str(created).encode()))
    with pytest.raises(WeightsError, match=r"invalid\.pt"):
        read_pt_weights(path, sha256_of(path))
    assert not created.exists()


def test_checksum_is_verified_before_unpickling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "other.pt"
    torch.save({}, path)

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("unpickled before the checksum was verified")

    monkeypatch.setattr(torch, "load", never)
    monkeypatch.setattr(pickle, "Unpickler", never)
    with pytest.raises(WeightsError, match="checksum"):
        read_pt_weights(path, "0" * 64)


def test_tensors_of_unavailable_classes_are_read_without_their_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The module classes exist only while the file is written, as on the computer on which a network was trained."""
    foreign = ModuleType("ultralytics.nn.modules.conv")

    class Conv(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv = nn.Conv2d(3, 4, 3, bias=False)
            self.bn = nn.BatchNorm2d(4)

        def __setstate__(self, state: dict[str, Any]) -> None:
            raise AssertionError("code of the foreign class ran")

    Conv.__module__, Conv.__qualname__ = foreign.__name__, "Conv"
    foreign.Conv = Conv  # type: ignore[attr-defined]
    for package in ("ultralytics", "ultralytics.nn", "ultralytics.nn.modules"):
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
    monkeypatch.setitem(sys.modules, foreign.__name__, foreign)
    network = nn.Sequential(Conv(), nn.Identity(), Conv()).half()
    path = tmp_path / "foreign.pt"
    torch.save({"model": network, "epoch": -1}, path)
    expected = network.state_dict()
    monkeypatch.undo()
    assert foreign.__name__ not in sys.modules

    tensors = read_pt_weights(path, sha256_of(path))
    assert tensors.keys() == expected.keys()
    assert all(torch.equal(tensors[name], tensor) for name, tensor in expected.items())
    assert foreign.__name__ not in sys.modules


def test_file_without_a_model_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "empty.pt"
    torch.save({"epoch": 3}, path)
    with pytest.raises(WeightsError, match="safely"):
        read_pt_weights(path, sha256_of(path))
