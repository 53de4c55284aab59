"""Documentation: it builds without warnings, describes every public name, and needs no network."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from typer.main import get_command

import v3d_torch
from v3d_torch.cli.commands import COMMANDS

ROOT = Path(v3d_torch.__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built site. Broken links and references to missing names are warnings, which are errors here."""
    folder = tmp_path_factory.mktemp("docs") / "site"
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return folder


class Page(HTMLParser):
    """Ids and text of a page, and the addresses that a browser loads to show it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.loaded: list[str] = []
        self.words: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        self.ids |= {attributes["id"]} if "id" in attributes else set()
        address = attributes.get("href", "") if tag == "link" else attributes.get("src", "")
        self.loaded += [address] if address else []

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, Page]:
    return {path.relative_to(site).as_posix(): Page(path) for path in site.rglob("*.html")}


def test_every_public_name_is_described(pages: dict[str, Page]) -> None:
    described = set().union(*(page.ids for page in pages.values()))
    for name in v3d_torch.__all__:
        public = getattr(v3d_torch, name)
        assert f"{public.__module__}.{public.__qualname__}" in described, name


def test_pages_load_nothing_from_other_hosts(pages: dict[str, Page]) -> None:
    assert len(pages) > 20
    for name, page in pages.items():
        assert [address for address in page.loaded if re.match(r"(https?:)?//", address)] == [], name


def test_formulas_are_rendered(site: Path, pages: dict[str, Page]) -> None:
    for name, page in pages.items():
        assert not re.search(r":math:|\.\. math::|\\frac|\\\(|\\\[|\$\$", page.text), name
    for stage in ("depth", "voting", "chamfer", "evaluation"):
        assert '<math xmlns="http://www.w3.org/1998/Math/MathML" display="block">' in (
            site / "stages" / f"{stage}.html"
        ).read_text(encoding="utf-8")


@pytest.mark.parametrize("module", COMMANDS, ids=lambda module: module.__name__.rpartition(".")[2])
def test_page_of_command_lists_all_options(module: object, pages: dict[str, Page]) -> None:
    name = module.__name__.rpartition(".")[2]
    text = pages[f"commands/{name}.html"].text
    for parameter in get_command(module.app).params:
        if parameter.name != "help":
            assert (max(parameter.opts, key=len) if parameter.opts[0].startswith("-") else "") in text
            assert " ".join((parameter.help or "").split()) in text


def test_configuration_page_is_written_from_the_schema() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "write_configuration.py"))
    assert script["PAGE"].read_text(encoding="utf-8") == script["page"]()


def test_pictures_are_outputs_of_the_notebooks() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "write_pictures.py"))
    for name, source in script["PICTURES"].items():
        assert (script["IMAGES"] / name).read_bytes() == script["picture"](*source), name


def test_index_of_stages_links_every_stage() -> None:
    stages = {path.stem for path in (ROOT / "docs" / "stages").glob("*.md")} - {"index"}
    text = (ROOT / "docs" / "stages" / "index.md").read_text(encoding="utf-8")
    assert {match[1] for match in re.finditer(r"\]\((\w+)\.md\)", text)} == stages
