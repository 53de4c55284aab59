"""Destination of a rerun recording: a viewer on the screen, a file, or both."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path
from uuid import uuid4

import rerun as rr

from v3d_torch.errors import OutputError, ViewerError

PORT = 9876
"""Port of rerun's viewer."""

_START_TIMEOUT = 20.0
"""Longest time for the viewer to start, seconds. On a busy machine, it takes several seconds."""

_POLL_INTERVAL = 0.2  # seconds

_DISPLAY_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
"""Environment variables, at least one of which is set on a Linux machine with a screen."""


def open_stream(*, live: bool, file: Path | None, port: int = PORT) -> rr.RecordingStream:
    """Open a recording.

    The file is written during the run, so that after a crash it holds everything until then.

    Args:
        live: True to show the recording in the viewer that listens on this machine, or in a new viewer.
        file: File to record to, ``.rrd``, which must not exist; None for no file.
        port: Port of the viewer.

    Raises:
        ViewerError: If no viewer can be started.
        OutputError: If the file exists, has another suffix or cannot be written.
    """
    if file is not None and file.suffix != ".rrd":  # the viewer does not open it
        raise OutputError(f"{file}: cannot be written as a recording of rerun; choose a name that ends in .rrd")
    # The library would replace the file, such as the first part of a run that is resumed with the same options.
    if file is not None and file.is_file():
        raise OutputError(f"{file}: already exists; delete it, or choose another file with --rerun")
    stream = rr.RecordingStream("v3d_torch", recording_id=uuid4())
    sinks: list[rr.GrpcSink | rr.FileSink] = []
    if live:
        _ensure_viewer(port)
        sinks.append(rr.GrpcSink(f"rerun+http://127.0.0.1:{port}/proxy"))
    try:
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            sinks.append(rr.FileSink(file))
        stream.set_sinks(*sinks)
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{file}: cannot be written ({error}); choose another file with --rerun") from error
    return stream


def _ensure_viewer(port: int) -> None:
    """Start a viewer unless one is listening already."""
    if _listens(port):
        return
    alternatives = (
        f"record with --rerun FILE.rrd and open the file elsewhere, or start a viewer on port {port} of this machine"
    )
    if sys.platform == "linux" and not any(os.environ.get(name) for name in _DISPLAY_VARIABLES):
        raise ViewerError(f"--viz rerun: no screen to open a viewer on; {alternatives}")
    # In an environment that is not activated, the program is not on the path, but beside the interpreter.
    program = shutil.which("rerun", path=Path(sys.executable).parent) or "rerun"  # rerun.exe on Windows
    # Not rerun.spawn, because its viewer accepts connections from the whole network.
    arguments = [f"--port={port}", "--bind=127.0.0.1", "--expect-data-soon"]
    try:
        viewer = subprocess.Popen([program, *arguments], start_new_session=True)  # noqa: S603 - outlives the run
    except OSError as error:
        raise ViewerError(f"--viz rerun: the viewer cannot be started ({error}); {alternatives}") from error
    deadline = time.monotonic() + _START_TIMEOUT
    while not _listens(port):
        if viewer.poll() is not None or time.monotonic() > deadline:
            raise ViewerError(f"--viz rerun: the viewer did not start, see its output above; {alternatives}")
        time.sleep(_POLL_INTERVAL)


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True
