"""What a wheel and a source archive of the package hold, and the one command that an installation brings."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

import v3d_torch
from v3d_torch.__main__ import COMMANDS, app

PACKAGE = Path(v3d_torch.__file__).parent
ROOT = PACKAGE.parent
SOURCES = (
    *("pyproject.toml", "MANIFEST.in", "README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "constraints.txt"),
    "mkdocs.yml",
    *("v3d_torch", "tests", "benchmarks", "notebooks", "docs"),
)
"""What a source archive is made of: a checkout without what builds and runs have left in it."""

RUBBISH = shutil.ignore_patterns("__pycache__", "*.pyc")


def left_out(folder: Path, names: list[str]) -> set[str]:
    return set(names) - set(SOURCES) if folder == ROOT else RUBBISH(str(folder), names)


def files_in(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }


def content(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist() if not name.endswith("/RECORD")}


def build(source: Path, out: Path, *options: str) -> None:
    """With the setuptools that is here, so that nothing is downloaded."""
    command = [sys.executable, "-m", "build", "--no-isolation", *options, "--outdir", str(out), str(source)]
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=100)  # noqa: S603


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A source archive, the wheel made of that archive, and the wheel made of the checkout."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(ROOT, folder / "checkout", ignore=lambda at, names: left_out(Path(at), names))
    build(folder / "checkout", folder / "released")
    build(folder / "checkout", folder / "direct", "--wheel")
    (archive,) = (folder / "released").glob("*.tar.gz")
    (released,), (direct,) = (list((folder / name).glob("*.whl")) for name in ("released", "direct"))
    return archive, released, direct


def test_the_wheel_holds_every_file_of_the_package(built: tuple[Path, Path, Path]) -> None:
    held = {name: data for name, data in content(built[1]).items() if name.startswith("v3d_torch/")}
    assert held == {f"v3d_torch/{name}": data for name, data in files_in(PACKAGE).items()}
    for name in (
        *("py.typed", "__init__.pyi", "configs/paper.yaml", "configs/ablations/baseline.yaml", "viz/page.html"),
        *("datasets/presets/tum_fr3.yaml", "datasets/assets/astronaut.png", "evaluation/paper_tables.yaml"),
    ):
        assert f"v3d_torch/{name}" in held


def test_the_wheel_is_of_this_package_alone_and_says_what_it_is(built: tuple[Path, Path, Path]) -> None:
    held = content(built[1])
    tops = {name.partition("/")[0] for name in held}
    (info,) = tops - {"v3d_torch"}
    metadata = held[f"{info}/METADATA"].decode()
    stated = "Name: v3d-torch", "License-Expression: Apache-2.0", "Requires-Python: >=3.11.4", "Provides-Extra: ray"
    for line in stated:
        assert f"\n{line}\n" in metadata
    assert (ROOT / "README.md").read_text() in metadata
    assert b"v3d-torch = v3d_torch.__main__:app" in held[f"{info}/entry_points.txt"]
    assert held[f"{info}/licenses/LICENSE"] == (ROOT / "LICENSE").read_bytes()


def test_the_source_archive_makes_the_same_wheel(built: tuple[Path, Path, Path]) -> None:
    _, released, direct = built
    assert content(released) == content(direct)


def test_the_source_archive_can_be_tested(built: tuple[Path, Path, Path]) -> None:
    with tarfile.open(built[0]) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    tests = {f"tests/{path.name}" for path in (ROOT / "tests").glob("*.py")}
    assert tests | {"constraints.txt", "CITATION.cff", "CHANGELOG.md", "LICENSE", "mkdocs.yml", "docs/index.md"} <= held
    assert not [name for name in held if re.search(r"__pycache__|\.pyc$|^results|^build", name)]


# --- the command


def test_every_command_of_the_package_is_under_the_one_name() -> None:
    typer_apps = {path.stem for path in PACKAGE.glob("*.py") if re.search(r"^app = typer", path.read_text(), re.M)}
    assert {module.__name__.rpartition(".")[2] for module in COMMANDS} == typer_apps - {"__main__"}


@pytest.mark.parametrize("module", COMMANDS, ids=lambda module: module.__name__.rpartition(".")[2])
def test_a_command_says_the_same_under_both_names(module: object) -> None:
    name = module.__name__.rpartition(".")[2]
    alone = CliRunner().invoke(module.app, ["--help"]).output
    together = CliRunner().invoke(app, [name, "--help"]).output
    assert alone.partition("\n")[2] == together.partition("\n")[2]
    assert f"{name} [OPTIONS]" in together.partition("\n")[0]


def test_the_list_of_commands_fits_a_terminal() -> None:
    lines = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output.split("Commands:")[1].splitlines()
    assert [line for line in lines if "..." in line or len(line) > 80] == []
    assert len([line for line in lines if line.strip()]) == len(COMMANDS)


def test_several_values_to_one_option_stay_those_of_the_option() -> None:
    result = CliRunner().invoke(app, ["batch", "--seqs", "no_such_a", "no_such_b", "--configs", "papper"])
    assert result.exit_code == 2 and "papper" in result.stderr


def test_help_loads_nothing_heavy_and_the_version_is_told() -> None:
    code = (
        "import sys; from v3d_torch.__main__ import app\n"
        "try: app(['run', '--help'])\n"
        "except SystemExit: print({'torch', 'cv2', 'numpy', 'rich.console'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert "--segmenter" in done.stdout and done.stdout.rstrip().endswith("set()")
    assert CliRunner().invoke(app, ["--version"]).output == f"v3d-torch {version('v3d-torch')}\n"


# --- to be cited


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    (paper,) = citation["references"]
    assert paper["title"].startswith("V3D-SLAM: ") and paper["year"] == 2024 and len(paper["authors"]) == 3
