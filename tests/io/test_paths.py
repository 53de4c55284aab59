"""Expansion of ``~`` in paths that no shell has expanded."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
from helpers.tiny_images import colour_of, depth_of, save
from typer.testing import CliRunner

from v3d_torch.cli.commands import COMMANDS
from v3d_torch.datasets import load_sequence
from v3d_torch.io.paths import cache_dir, expand_user

CAMERA = "fx: 30\nfy: 30\ncx: 15.5\ncy: 11.5\nwidth: 32\nheight: 24\ndepth_scale: 5000\n"


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Home folder with a sequence ``desk`` of three frames and a camera file."""
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(tmp_path))
    for i in range(3):
        save(tmp_path / "desk" / "rgb" / f"{10 + i}.500000.png", colour_of(i, 32, 24))
        save(tmp_path / "desk" / "depth" / f"{10 + i}.500000.png", depth_of(i, 32, 24))
    (tmp_path / "camera.yaml").write_text(CAMERA)
    return tmp_path


@pytest.mark.parametrize("variable", [None, "V3D_DATA"])
def test_home_is_expanded_in_sequence_and_camera_paths(monkeypatch: pytest.MonkeyPatch, variable: str | None) -> None:
    if variable is not None:
        monkeypatch.setenv(variable, "~")
    root = "~" if variable is None else None
    assert len(load_sequence("desk", data_root=root, camera="~/camera.yaml")) == 3
    assert len(load_sequence("~/desk", camera=Path("~/camera.yaml"))) == 3


def test_home_is_expanded_in_the_cache_path(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("V3D_CACHE", "~/cache")
    assert cache_dir() == home / "cache"


def test_home_is_expanded_in_the_options_of_a_command(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(home / "desk")
    (record,) = (module for module in COMMANDS if module.__name__.endswith("record"))
    arguments = ["--seq=~/desk", "--camera=~/camera.yaml", "--out=~/copy"]
    done = CliRunner().invoke(record.app, arguments)
    assert done.exit_code == 0, done.stderr
    assert len(load_sequence(home / "copy")) == 3 and not (home / "desk" / "~").exists()


@pytest.mark.parametrize("module", COMMANDS, ids=lambda module: module.__name__)
def test_every_command_expands_home(module: ModuleType) -> None:
    (command,) = module.app.registered_commands
    assert command.callback.__wrapped__.__module__ == module.__name__


def test_home_of_an_unknown_user_stays_unchanged() -> None:
    assert expand_user("~nobody-of-that-name/x") == Path("~nobody-of-that-name/x")


def test_cache_dir_is_set_by_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("V3D_CACHE", str(tmp_path))
    assert cache_dir() == tmp_path
    monkeypatch.delenv("V3D_CACHE")
    assert cache_dir().name == "v3d_torch"
