"""Log file of a run."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from logging.handlers import WatchedFileHandler
from pathlib import Path

from v3d_torch.errors import OutputError
from v3d_torch.io.text import printable

_LOG = logging.getLogger("v3d_torch")


@contextmanager
def log_to(path: Path, *, append: bool = False) -> Iterator[None]:
    """Write the log of the package to a file; an exception that leaves the block is logged with its traceback.

    In the block the log contains messages of level INFO, and does not reach the handlers of the root logger.

    Args:
        path: Log file.
        append: True to append to the file, False to start a new one.

    Raises:
        OutputError: If the file cannot be written.
    """
    try:
        remove_link(path)
        if not append:
            path.write_text("")  # not replaced, because the output of a batch's process already goes to the file
        # Append mode: if the interpreter crashes, faulthandler can write its report to the same file.
        handler = _LogFile(path, mode="a", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another folder with --out") from error
    handler.setFormatter(_OneLine("%(asctime)s %(levelname)s %(message)s"))
    level, propagate = _LOG.level, _LOG.propagate
    _LOG.addHandler(handler)
    _LOG.setLevel(logging.INFO)
    _LOG.propagate = False
    try:
        yield
    except Exception:
        _LOG.exception("the run failed")
        raise
    finally:
        _LOG.setLevel(level)
        _LOG.propagate = propagate
        _LOG.removeHandler(handler)
        handler.close()


def remove_link(path: Path) -> None:
    """Remove a link in the place of a log. The file to which it leads is not of a run, and stays as it is.

    Raises:
        OSError: If the folder cannot be written.
    """
    if path.is_symlink():
        path.unlink()


@contextmanager
def show_warnings(show: Callable[[str], object]) -> Iterator[None]:
    """Pass the warnings in the log of the package to a function, such as one that prints them."""
    handler = _Warnings(show)
    _LOG.addHandler(handler)
    try:
        yield
    finally:
        _LOG.removeHandler(handler)


class _OneLine(logging.Formatter):
    """Format of a log in which each message is one line, also if a name in it contains line breaks."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))

    def format(self, record: logging.LogRecord) -> str:  # with the traceback, if there is one
        return "\n".join(map(printable, super().format(record).split("\n")))


class _Warnings(logging.Handler):
    """Handler that passes each warning, as one line, to a function."""

    def __init__(self, show: Callable[[str], object]) -> None:
        super().__init__(logging.WARNING)
        self._show = show

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.WARNING:  # errors are shown at the end of the run
            self._show(f"warning: {record.getMessage()}")


class _LogFile(WatchedFileHandler):
    """Log file that ignores a full disk: the run continues, and the error is reported when results are written.

    If the file is removed, it begins again with the next message for which its folder exists.
    """

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):  # the folder does not exist
            super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:
        if not isinstance(sys.exception(), OSError):
            super().handleError(record)

    def close(self) -> None:
        with suppress(OSError):
            super().close()
