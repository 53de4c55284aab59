"""Commands, links and code in README and docs: they parse, exist and run."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
from typer.main import get_command

import v3d_torch
from v3d_torch.cli.commands import COMMANDS
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import TrackingStatus

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MODULES = {module.__name__.rpartition(".")[2]: module for module in COMMANDS}


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def commands(path: Path) -> list[list[str]]:
    """Commands of this package in the code blocks of a page: name and arguments, split as in a shell."""
    found = []
    for line in "".join(blocks(path, "bash")).splitlines():
        for part in line.split("&&"):
            words = shlex.split(part.partition(" > ")[0], comments=True)
            if words[:3] == ["python", "-m", "v3d_torch"]:
                found.append(words[3:])
            elif words[:3] == ["python", "-m", "v3d_torch.run"]:
                found.append(["run", *words[3:]])
            elif words[:1] == ["v3d-torch"]:
                found.append(words[1:])
    return found


DOCUMENTED = [(page, words) for page in PAGES for words in commands(page)]


def test_readme_shows_every_command() -> None:
    assert {words[0] for page, words in DOCUMENTED if page == PAGES[0]} == set(MODULES)
    assert len(DOCUMENTED) > 30


@pytest.mark.parametrize(
    "words",
    [words for _, words in DOCUMENTED],
    ids=[f"{page.stem}: {' '.join(words)}" for page, words in DOCUMENTED],
)
def test_documented_command_parses(words: list[str]) -> None:
    get_command(MODULES[words[0]].app).make_context(words[0], words[1:])  # raises a usage error if it does not parse


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_of_page_exist(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert target.startswith("http") or (page.parent / target).exists(), target


def test_readme_example_runs(moment: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The example runs on six frames of the demo."""
    code = blocks(ROOT / "README.md", "python")[0]
    assert len(code.splitlines()) <= 10 and 'load_sequence("demo")' in code
    monkeypatch.setattr(v3d_torch, "load_sequence", lambda name: load_sequence(str(moment)))
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)  # noqa: S102
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(names["trajectory"]) == 6  # type: ignore[arg-type]
    assert re.fullmatch(r"\d\.\d\d s, tracked: camera at \[.*\], moving: \[.*\]", lines[-1])


def test_stages_of_the_documentation_run(moment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The segmenter, the depth stage and the odometry of the page track the demo as the built-in stages do."""
    sequence = load_sequence(str(moment))
    monkeypatch.setattr(v3d_torch, "load_sequence", lambda name: sequence)
    no_boxes = torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), torch.zeros(0)
    names: dict[str, Any] = {"my_detector": lambda image: no_boxes}
    for code in blocks(ROOT / "docs" / "your_stage.md", "python"):
        exec(compile(code, "your_stage.md", "exec"), names)  # noqa: S102
    no_network = load_config(overrides=["segmentation.source=masks"])
    expected = V3DSLAM(sequence.camera, names["Detector"](), no_network)
    slam = V3DSLAM(sequence.camera, names["Detector"](), no_network)
    slam.smooth_depth, slam.odometry = names["MedianDepth"](), names["PnPOdometry"](sequence.camera)
    measured = []
    for frame in sequence:
        difference = expected(frame).T_wc[:3, 3] - slam(frame).T_wc[:3, 3]
        assert difference.norm() < 0.01 and slam.poses.status is TrackingStatus.TRACKED
        measured.append(slam.poses.is_motion_measured)
    assert measured == [False, *[True] * 5]
    depth = sequence[0].depth[None]
    assert torch.equal(slam.smooth_depth(depth) > 0, depth > 0)
    assert not torch.equal(slam.smooth_depth(depth), depth)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_python_on_page_compiles(page: Path) -> None:
    for code in blocks(page, "python"):
        compile(code, str(page), "exec")
