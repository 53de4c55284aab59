"""The run command in this process or in another one, and assertions on the output of commands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import chdir
from pathlib import Path

from typer import Typer
from typer.testing import CliRunner, Result

from helpers.folders import names_in
from v3d_torch.cli import run

RUN_FILES = {
    *("trajectory.txt", "keyframes.txt", "groundtruth.txt", "config.yaml", "request.yaml", "metrics.json", "run.log"),
    *("frames.parquet", "states.parquet", "objects.parquet", "map.ply", "trajectory.ply"),
    *("figures/trajectory.png", "figures/masks.png"),
}
"""Files that every run with ground truth writes."""

REPEATABLE_FILES = ("trajectory.txt", "keyframes.txt", "objects.parquet", "map.ply", "trajectory.ply")
"""Files of every run that are the same to the byte if the run is repeated."""

REPEATABLE_METRICS = (
    *("ate", "rpe", "coverage", "status", "frames", "processed", "skipped", "keyframes", "landmarks", "loops"),
    "failure",
)
"""Keys of ``metrics.json`` whose values are the same if the run is repeated."""


def command(*arguments: str | Path) -> list[str]:
    # One thread by default: several would wait for each other on shared cores, and the results are the same.
    return [sys.executable, "-m", "v3d_torch.run", "--set", "threads=1", *map(str, arguments)]


def environment(**changes: str) -> dict[str, str]:
    own = {key: value for key, value in os.environ.items() if key != "V3D_DATA"}
    return own | {"COLUMNS": "120", "NO_COLOR": "1"} | changes


def call(*arguments: str | Path, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # noqa: S603
        command(*arguments), cwd=cwd, env=environment(**variables), capture_output=True, text=True, timeout=500
    )


def invoke(app: Typer, *arguments: str | Path, **variables: str | None) -> Result:
    """Call any command in this process, with changes of the environment; None for variables that are not set."""
    return CliRunner().invoke(app, list(map(str, arguments)), env=variables)


def call_here(*arguments: str | Path, cwd: Path, **variables: str) -> Result:
    """Call the run command in this process, which has imported everything already."""
    with chdir(cwd):
        return invoke(
            run.app, *command(*arguments)[3:], **{"V3D_DATA": None, "COLUMNS": "120", "NO_COLOR": "1", **variables}
        )


def assert_error_line(done: subprocess.CompletedProcess[str] | Result, *words: str | Path) -> None:
    """Check that a command ended with exit code 2 and one line on stderr that contains the words."""
    if isinstance(done, Result):
        assert done.exit_code == 2 and (done.exception is None or isinstance(done.exception, SystemExit)), done.exc_info
    else:
        assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    for word in words:
        assert str(word) in done.stderr


def assert_same_results(out: Path, expected: Path, files: Sequence[str] = REPEATABLE_FILES) -> None:
    """Check that the folders of two runs have the same files with the same poses, objects, maps and scores.

    Args:
        out: Folder of a run.
        expected: Folder of another run.
        files: Files whose bytes are compared.
    """
    for name in files:
        assert (out / name).read_bytes() == (expected / name).read_bytes(), name
    first, second = (json.loads((folder / "metrics.json").read_text()) for folder in (out, expected))
    for key in REPEATABLE_METRICS:
        assert first[key] == second[key], key
    names = [set(names_in(folder)) - {"figures"} for folder in (out, expected)]
    assert names[0] == names[1]


def files_in(folder: Path) -> set[str]:
    """Return the paths of all files in a folder, relative to the folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
