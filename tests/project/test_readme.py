"""Commands, links and code in README and docs: they parse, exist and run."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.main import get_command

import v3d_torch
from v3d_torch.__main__ import COMMANDS
from v3d_torch.datasets import load_sequence

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
    ("page", "words"), DOCUMENTED, ids=[f"{page.stem}: {' '.join(words)}" for page, words in DOCUMENTED]
)
def test_documented_command_parses(page: Path, words: list[str]) -> None:
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_python_on_page_compiles(page: Path) -> None:
    for code in blocks(page, "python"):
        compile(code, str(page), "exec")
