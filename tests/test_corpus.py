"""Runs of all damaged inputs of the corpus: a correct result, or one error message and the partial results."""

from __future__ import annotations

import json
import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from helpers.corpus import CATEGORIES
from helpers.corpus.base import write_base
from helpers.corpus.case import Case, Fails, Succeeds, Workspace
from helpers.forked_command import call_forked
from typer.testing import CliRunner

from v3d_torch.cli import run

CASES = [
    pytest.param(category, case, id=f"{category}: {case.name}")
    for category, cases in CATEGORIES.items()
    for case in cases
]
WITH_FIGURES = {"image content", "sequence names", "results and permissions"}
"""Categories whose runs draw figures. Drawing takes most of the time of such short runs."""

SHELL = {
    "ground truth": "word instead of a number",
    "sequence names": "folder name with a line break",
}
"""Cases that are also run in a process of their own, whose output and exit code the user sees."""

_MEMORY = 2 << 30
"""Memory limit of a case on top of the current use, bytes. A decompression bomb exceeds this limit."""


@pytest.fixture(scope="session")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus") / "seq"
    write_base(folder)
    return folder


@pytest.fixture
def place(base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Workspace]:
    """Create a working directory with a copy of the intact sequence."""
    shutil.copytree(base, tmp_path / "seq")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("V3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("V3D_DATA", raising=False)
    place = Workspace(tmp_path)
    place.seq = str(place.folder)
    yield place
    for path in tmp_path.rglob("*"):  # so that pytest can remove folders without permissions
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o700)


@contextmanager
def memory_limit() -> Iterator[None]:
    """Limit the additional memory to `_MEMORY`, if the system reports the current use."""
    status = Path("/proc/self/statm")
    if not status.is_file():
        yield
        return
    used = int(status.read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def arguments(place: Workspace) -> list[str]:
    return ["--seq", place.seq, "--out", str(place.out), *place.options]


def assert_expected_end(place: Workspace, ends: Succeeds | Fails, code: int, stdout: str, stderr: str) -> None:
    if isinstance(ends, Succeeds):
        assert (code, stderr) == (0, "")
        metrics = json.loads((place.out / "metrics.json").read_text())
        assert (metrics["processed"], metrics["lost"], metrics["failure"]) == (ends.frames, ends.lost, None)
        assert saved_poses(place) == ends.frames
        assert (metrics["ate"] is None) == (ends.max_ate is None)
        assert ends.max_ate is None or metrics["ate"]["rmse"] < ends.max_ate
        assert ends.note in stdout
    else:
        assert code == 2, stderr
        assert stderr.startswith("error: ") and stderr.endswith("\n") and stderr.count("\n") == 1, stderr
        assert ends.fits(stderr.removeprefix("error: ").removesuffix("\n"), place), stderr
        assert saved_poses(place) == ends.saved_poses


def saved_poses(place: Workspace) -> int | None:
    """Number of poses in the results; None if there are no results."""
    trajectory = place.out / "trajectory.txt"
    return len(trajectory.read_text().splitlines()) if trajectory.is_file() else None


@pytest.mark.timeout(60)
@pytest.mark.filterwarnings("error", "ignore::DeprecationWarning")
@pytest.mark.parametrize(("category", "case"), CASES)
def test_damaged_input_ends_as_expected(
    category: str, case: Case, place: Workspace, capfd: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    if category not in WITH_FIGURES:
        request.getfixturevalue("undrawn")
    case.damage(place)
    with case.context(place), memory_limit():
        done = CliRunner().invoke(run.app, arguments(place))
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exc_info
    assert_expected_end(place, case.expected, done.exit_code, done.stdout, done.stderr)
    assert capfd.readouterr().err == ""  # libraries must not write to stderr either
    assert not list(place.root.glob("**/*.part*"))


@pytest.mark.parametrize(("category", "name"), SHELL.items(), ids=SHELL)
def test_damaged_input_ends_as_expected_in_a_process_of_its_own(category: str, name: str, place: Workspace) -> None:
    case = next(case for case in CATEGORIES[category] if case.name == name)
    case.damage(place)
    done = call_forked(*arguments(place), cwd=place.root, COLUMNS="200")
    assert_expected_end(place, case.expected, done.returncode, done.stdout, done.stderr)


def test_case_names_are_unique() -> None:
    for cases in CATEGORIES.values():
        assert len({case.name for case in cases}) == len(cases)
    assert sum(len(cases) for cases in CATEGORIES.values()) >= 60


def test_earlier_results_are_replaced_and_other_files_are_kept(place: Workspace) -> None:
    (case,) = (case for case in CATEGORIES["results and permissions"] if case.name == "results of an earlier run")
    case.damage(place)
    assert CliRunner().invoke(run.app, arguments(place)).exit_code == 0
    assert (place.out / "notes.txt").read_text() == "of an earlier run"
    stamps = [f"{float(line.split()[0]):.6f}.png" for line in (place.out / "trajectory.txt").read_text().splitlines()]
    assert sorted(path.name for path in (place.out / "masks").iterdir()) == stamps
