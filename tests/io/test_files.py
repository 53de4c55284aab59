"""Atomic writes, writability checks, file locks and PNG images."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import cv2
import numpy as np
import pytest

from v3d_torch.errors import OutputError
from v3d_torch.io.files import (
    atomic_write,
    check_empty_folder,
    check_writable,
    emptied_on_failure,
    file_lock,
    write_png,
    write_text,
)


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a" / "table.txt"
    write_text(path, "höhe\n")
    assert path.read_bytes() == "höhe\n".encode()
    with pytest.raises(ZeroDivisionError), atomic_write(path) as temporary:
        temporary.write_text("half")
        assert temporary.suffix == ".txt" and temporary.parent == path.parent
        raise ZeroDivisionError
    assert path.read_text(encoding="utf-8") == "höhe\n"
    assert [entry.name for entry in path.parent.iterdir()] == ["table.txt"]


def test_threads_that_write_the_same_file_do_not_disturb_each_other(tmp_path: Path) -> None:
    path, barrier = tmp_path / "table.txt", Barrier(4)

    def write(text: str) -> None:
        with atomic_write(path) as temporary:
            barrier.wait(10)
            temporary.write_text(text)
            barrier.wait(10)
            assert temporary.read_text() == text

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, "abcd"))
    assert path.read_text() in "abcd" and list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
def test_written_file_has_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain.txt").touch()
    write_text(tmp_path / "table.txt", "")
    assert (tmp_path / "table.txt").stat().st_mode == (tmp_path / "plain.txt").stat().st_mode


def test_longest_name_of_a_file_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / f"{'x' * 251}.txt"
    write_text(path, "text")
    assert path.read_text() == "text"


def test_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/x\.txt: cannot be written"):
        write_text(tmp_path / "file" / "x.txt", "")
    with pytest.raises(OutputError, match="No space left"), atomic_write(tmp_path / "y.txt"):
        raise OSError(28, "No space left on device")
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_unwritable_path_is_rejected_before_the_run(tmp_path: Path) -> None:
    check_writable(tmp_path / "new" / "room.map")
    assert (tmp_path / "new").is_dir() and not any((tmp_path / "new").iterdir())
    (tmp_path / "file").write_text("old")
    check_writable(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "old"
    for path in (tmp_path, tmp_path / "file" / "room.map"):
        with pytest.raises(OutputError, match="cannot be written"):
            check_writable(path)


def test_only_a_new_or_empty_folder_is_empty(tmp_path: Path) -> None:
    check_empty_folder(tmp_path / "new")
    check_empty_folder(tmp_path)
    (tmp_path / "file").write_text("old")
    for path in (tmp_path, tmp_path / "file"):
        with pytest.raises(OutputError, match=r"is not an empty folder; choose another folder with --out"):
            check_empty_folder(path)


@pytest.mark.skipif(os.name == "nt", reason="symbolic links on Windows need special permissions")
@pytest.mark.parametrize("is_new", [True, False])
def test_failure_empties_the_folder_but_not_what_its_links_lead_to(tmp_path: Path, is_new: bool) -> None:
    folder, own = tmp_path / "out", tmp_path / "own"
    (own / "inside").mkdir(parents=True)
    if not is_new:
        folder.mkdir()
    with pytest.raises(ZeroDivisionError), emptied_on_failure(folder):
        (folder / "images").mkdir(parents=True)
        (folder / "images" / "0.png").touch()
        (folder / "link").symlink_to(own)
        raise ZeroDivisionError
    assert (own / "inside").is_dir() and folder.exists() is not is_new
    assert is_new or not any(folder.iterdir())


def test_convention_png_is_written_from_rgb(tmp_path: Path) -> None:
    colour = np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    write_png(tmp_path / "colour.png", colour)
    write_png(tmp_path / "grey.png", colour[..., 0])
    assert np.array_equal(cv2.imread(str(tmp_path / "colour.png"))[..., ::-1], colour)
    assert np.array_equal(cv2.imread(str(tmp_path / "grey.png"), cv2.IMREAD_UNCHANGED), colour[..., 0])


def make_folder_once(target: Path) -> None:
    with file_lock(target):
        if not target.exists():
            count = target.with_name("count")
            count.write_text(count.read_text() + "x" if count.exists() else "x")
            target.mkdir()


def test_lock_lets_one_of_many_processes_make_a_folder(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=make_folder_once, args=(tmp_path / "made",)) for _ in range(6)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=30)
    assert [worker.exitcode for worker in workers] == [0] * 6
    assert (tmp_path / "count").read_text() == "x"
