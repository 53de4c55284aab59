"""Log file of a run, and warnings on the console."""

from __future__ import annotations

import logging
import os
import shutil
from pathlib import Path

import pytest

from v3d_torch.runs.log import log_to, show_warnings

LOG = logging.getLogger("v3d_torch.test")


def test_message_is_one_line_without_control_characters(tmp_path: Path) -> None:
    """A file name can contain line breaks, which would forge a line of the log, and commands for the terminal."""
    path, name = tmp_path / "run.log", "a\n2026-01-01 00:00:00,000 ERROR forged\x1b]0;title\x1b\\"
    with pytest.raises(ValueError, match="forged"), log_to(path):
        LOG.warning("%s is broken", name)
        raise ValueError(name)
    text = path.read_text()
    assert text.splitlines()[0].endswith("forged\\x1b]0;title\\x1b\\ is broken")
    assert "Traceback (most recent call last):\n" in text and "\x1b" not in text


def test_logger_of_the_package_is_as_before_after_a_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    package = logging.getLogger("v3d_torch")
    caplog.set_level(logging.ERROR, package.name)
    with pytest.raises(ValueError, match="broken"), log_to(tmp_path / "run.log"):
        assert (package.level, package.propagate) == (logging.INFO, False)
        raise ValueError("broken")
    assert (package.level, package.propagate) == (logging.ERROR, True)


@pytest.mark.skipif(os.name == "nt", reason="Windows does not remove open files")
def test_removed_log_begins_again_when_there_is_a_folder(tmp_path: Path) -> None:
    path = tmp_path / "out" / "run.log"
    path.parent.mkdir()
    with log_to(path):
        LOG.warning("first")
        shutil.rmtree(path.parent)
        LOG.warning("second")
        assert not path.parent.exists()
        path.parent.mkdir()
        LOG.warning("third")
        LOG.warning("fourth")
    assert [line.split()[-1] for line in path.read_text().splitlines()] == ["third", "fourth"]


@pytest.mark.skipif(os.name == "nt", reason="symbolic links on Windows need special permissions")
def test_new_log_replaces_a_link_and_keeps_its_target(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("own notes")
    (tmp_path / "run.log").symlink_to(tmp_path / "notes.txt")
    with log_to(tmp_path / "run.log"):
        LOG.warning("a frame is broken")
    assert (tmp_path / "notes.txt").read_text() == "own notes"
    assert (tmp_path / "run.log").read_text().endswith("a frame is broken\n")


def test_only_warnings_are_shown_not_errors(tmp_path: Path) -> None:
    shown: list[str] = []
    with log_to(tmp_path / "run.log"), show_warnings(shown.append):
        LOG.info("a note")
        LOG.warning("%s is dark", "the image")
        LOG.error("the run failed")
    LOG.warning("later")
    assert shown == ["warning: the image is dark"]
