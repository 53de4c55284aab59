"""Contents of the wheel and the source archive, the installed command, the citation file."""

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
from v3d_torch.cli import run
from v3d_torch.cli.commands import COMMANDS, app

PACKAGE = Path(v3d_torch.__file__).parent
ROOT = PACKAGE.parent
SOURCES = (
    *("pyproject.toml", "MANIFEST.in", "README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "constraints.txt"),
    *("CONTRIBUTING.md", "mkdocs.yml"),
    *("v3d_torch", "tests", "benchmarks", "notebooks", "examples", "docs"),
)
"""Files and folders of a checkout, without the leftovers of builds and runs."""

CACHES = shutil.ignore_patterns("__pycache__", "*.pyc")


def ignored(folder: Path, names: list[str]) -> set[str]:
    return set(names) - set(SOURCES) if folder == ROOT else CACHES(str(folder), names)


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
    """Build with the installed setuptools, so that nothing is downloaded."""
    command = [sys.executable, "-m", "build", "--no-isolation", *options, "--outdir", str(out), str(source)]
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=100)  # noqa: S603


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Source archive, wheel built from the archive, and wheel built from the checkout."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(ROOT, folder / "checkout", ignore=lambda at, names: ignored(Path(at), names))
    build(folder / "checkout", folder / "released")
    build(folder / "checkout", folder / "direct", "--wheel")
    (archive,) = (folder / "released").glob("*.tar.gz")
    (released,), (direct,) = (list((folder / name).glob("*.whl")) for name in ("released", "direct"))
    return archive, released, direct


def test_wheel_contains_every_file_of_the_package(built: tuple[Path, Path, Path]) -> None:
    contained = {name: data for name, data in content(built[1]).items() if name.startswith("v3d_torch/")}
    assert contained == {f"v3d_torch/{name}": data for name, data in files_in(PACKAGE).items()}
    for name in (
        *("py.typed", "__init__.pyi", "config/yaml/paper.yaml", "config/yaml/ablations/baseline.yaml"),
        *("datasets/presets/tum_fr3.yaml", "datasets/assets/astronaut.png", "evaluation/paper_tables.yaml"),
        "runs/report_page.html",
    ):
        assert f"v3d_torch/{name}" in contained


def test_wheel_contains_only_this_package_with_its_metadata(built: tuple[Path, Path, Path]) -> None:
    contained = content(built[1])
    tops = {name.partition("/")[0] for name in contained}
    (info,) = tops - {"v3d_torch"}
    metadata = contained[f"{info}/METADATA"].decode()
    expected = "Name: v3d-torch", "License-Expression: Apache-2.0", "Requires-Python: >=3.11.4", "Provides-Extra: ray"
    for line in expected:
        assert f"\n{line}\n" in metadata
    assert (ROOT / "README.md").read_text() in metadata
    assert b"v3d-torch = v3d_torch.__main__:main" in contained[f"{info}/entry_points.txt"]
    assert contained[f"{info}/licenses/LICENSE"] == (ROOT / "LICENSE").read_bytes()


def test_source_archive_builds_the_same_wheel(built: tuple[Path, Path, Path]) -> None:
    _, released, direct = built
    assert content(released) == content(direct)


def test_source_archive_contains_tests_and_documents(built: tuple[Path, Path, Path]) -> None:
    with tarfile.open(built[0]) as archive:
        contained = {name.partition("/")[2] for name in archive.getnames()}
    tests = {f"tests/{name}" for name in files_in(ROOT / "tests")}
    assert tests | {name for name in SOURCES if (ROOT / name).is_file()} | {"docs/index.md"} <= contained
    assert not [name for name in contained if re.search(r"__pycache__|\.pyc$|^results|^build", name)]


# --- the command


def test_every_command_module_is_a_subcommand() -> None:
    modules = {path.stem for path in (PACKAGE / "cli").glob("*.py") if re.search(r"^app = ", path.read_text(), re.M)}
    assert {module.__name__.rpartition(".")[2] for module in COMMANDS} == modules - {"commands"}  # all of them


@pytest.mark.parametrize("module", COMMANDS, ids=lambda module: module.__name__.rpartition(".")[2])
def test_subcommand_has_help_of_its_module(module: object) -> None:
    name = module.__name__.rpartition(".")[2]
    alone = CliRunner().invoke(module.app, ["--help"]).output
    together = CliRunner().invoke(app, [name, "--help"]).output
    assert alone.partition("\n")[2] == together.partition("\n")[2]
    assert f"{name} [OPTIONS]" in together.partition("\n")[0]


def test_list_of_commands_fits_80_columns() -> None:
    lines = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output.split("Commands:")[1].splitlines()
    assert [line for line in lines if "..." in line or len(line) > 80] == []
    assert len([line for line in lines if line.strip()]) == len(COMMANDS)


def test_option_with_several_values_takes_all_of_them() -> None:
    result = CliRunner().invoke(app, ["batch", "--seqs", "no_such_a", "no_such_b", "--configs", "papper"])
    assert result.exit_code == 2 and "papper" in result.stderr


def test_help_loads_no_heavy_library_and_version_is_printed() -> None:
    code = (
        "import sys; from v3d_torch.cli.commands import app\n"
        "try: app(['run', '--help'])\n"
        "except SystemExit: print({'torch', 'cv2', 'numpy', 'rich.console'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert "--segmenter" in done.stdout and done.stdout.rstrip().endswith("set()")
    for arguments in (["--version"], ["run", "--version"]):
        assert CliRunner().invoke(app, arguments).output == f"v3d-torch {version('v3d-torch')}\n"


@pytest.mark.parametrize("module", COMMANDS, ids=lambda module: module.__name__.rpartition(".")[2])
def test_python_dash_m_runs_every_command(module: object) -> None:
    name = module.__name__.rpartition(".")[2]
    command = [sys.executable, "-m", "v3d_torch", name, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    assert f"Usage: v3d-torch {name} [OPTIONS]" in done.stdout


def test_run_is_the_only_command_module_of_the_root() -> None:
    done = subprocess.run([sys.executable, "-m", "v3d_torch.run", "--help"], capture_output=True, text=True, check=True)
    assert "--segmenter" in done.stdout
    assert [module for module in COMMANDS if (PACKAGE / f"{module.__name__.rpartition('.')[2]}.py").exists()] == [run]


# --- citation


def test_citation_has_current_version_and_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    (paper,) = citation["references"]
    assert paper["title"].startswith("V3D-SLAM: ") and paper["year"] == 2024 and len(paper["authors"]) == 3
