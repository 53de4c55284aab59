"""The log of a run."""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from pathlib import Path

from v3d_torch.errors import OutputError


class LogFile(logging.FileHandler):
    """Writes a log to a new file. A disk that is full ends the log, not the run: the results come to tell.

    Raises:
        OutputError: the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        try:
            super().__init__(path, mode="w", encoding="utf-8", errors="backslashreplace")
        except OSError as error:
            raise OutputError(
                f"{path}: cannot be written ({error.strerror}); choose another folder with --out"
            ) from error
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: D102
        if not isinstance(sys.exception(), OSError):
            super().handleError(record)

    def close(self) -> None:  # noqa: D102
        with suppress(OSError):
            super().close()
