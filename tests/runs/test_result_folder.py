"""Result folders named by time, and the link to the newest."""

from __future__ import annotations

import ast
import errno
import subprocess
import sys
from datetime import datetime, tzinfo
from pathlib import Path

import pytest
from filelock import FileLock

from v3d_torch.config import Config
from v3d_torch.errors import OutputError
from v3d_torch.runs import file_names, result_folder
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.request import RunRequest, write_request


def test_runs_started_in_the_same_second_have_separate_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class FixedTime(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> FixedTime:
            return cls(2026, 1, 2, 3, 4, 5, tzinfo=tz)

    monkeypatch.setattr(result_folder, "datetime", FixedTime)
    monkeypatch.chdir(tmp_path)
    folders = [result_folder.make_result_folder(None, "fr3/w/xyz") for _ in range(3)]
    assert [folder.name for folder in folders] == [f"2026-01-02_03-04-05{suffix}" for suffix in ("", "_2", "_3")]
    assert (tmp_path / "results" / "fr3_w_xyz" / "latest").resolve() == folders[-1].resolve()


def test_make_result_folder_without_symlink_permission_makes_no_latest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "A required privilege is not held by the client")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    monkeypatch.chdir(tmp_path)
    folder = result_folder.make_result_folder(None, "demo")
    assert folder.is_dir() and [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_make_result_folder_that_fails_raises_output_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "results").symlink_to("nowhere")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match=r"demo: cannot be made \(.*\); choose another folder with --out"):
        result_folder.make_result_folder(None, "demo")


_HOLD = """
import sys
from pathlib import Path
from v3d_torch.runs.result_folder import lock_results
with lock_results(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_folder_of_another_run_cannot_be_locked_until_that_run_ends_or_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    for kill in (False, True):
        with subprocess.Popen(  # noqa: S603
            [sys.executable, "-c", _HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as other:
            assert other.stdout is not None and other.stdout.readline() == "locked\n"
            with (
                pytest.raises(OutputError, match=r"out: another run or batch is writing to this folder; wait .*--out$"),
                result_folder.lock_results(folder),
            ):
                pass
            if kill:
                other.kill()
            other.communicate()
        with result_folder.lock_results(folder):
            assert [path.name for path in folder.iterdir()] == [".run.lock"]
        assert list(folder.iterdir()) == []


@pytest.mark.parametrize("error", [OSError(errno.ENOLCK, "No locks available"), NotImplementedError()])
def test_folder_on_a_file_system_without_locks_is_used_without_one(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(FileLock, "acquire", refuse)
    with result_folder.lock_results(tmp_path / "out"):
        assert (tmp_path / "out").is_dir()


def test_names_of_result_files_are_written_once() -> None:
    """A file whose name is not in `RunFile` would stay when a folder is cleared."""
    source = Path(file_names.__file__)
    for path in (path for folder in ("runs", "batch", "cli") for path in (source.parents[1] / folder).glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)} & set(RunFile)
        assert path == source or not names, path


@pytest.mark.parametrize("saved", [True, False])
def test_masks_of_the_user_are_no_earlier_results(tmp_path: Path, saved: bool) -> None:
    """An earlier run in the folder wrote no masks; then the user put masks there."""
    write_request(tmp_path, RunRequest("demo", Config(), save_masks=saved))
    (tmp_path / "masks").mkdir()
    for name in ("run.log", "metrics.json", "masks/1.png"):
        (tmp_path / name).write_text("")
    result_folder.clear_earlier_results(tmp_path)
    assert (tmp_path / "masks" / "1.png").exists() is not saved
    assert not (tmp_path / "metrics.json").exists()
