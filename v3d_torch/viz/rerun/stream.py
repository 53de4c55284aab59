"""Where a rerun recording goes: to a viewer on the screen, to a file, or to both."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from uuid import uuid4

import rerun as rr

from v3d_torch.errors import OutputError, ViewerError

PORT = 9876
"""On which rerun's viewer listens."""

_PATIENCE = 20.0  # seconds: a busy machine takes its time
_SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


def open_stream(*, live: bool, file: Path | None, port: int = PORT) -> rr.RecordingStream:
    """Begin a recording.

    A file is written as the run goes: what was recorded until a crash can be looked at.

    Args:
        live: whether to show it in the viewer that listens on this machine, or in a new one.
        file: to record to, ``.rrd``; None for none.
        port: of the viewer.

    Raises:
        ViewerError: no viewer can be started.
        OutputError: the file cannot be written.
    """
    stream = rr.RecordingStream("v3d_torch", recording_id=uuid4())
    sinks: list[rr.GrpcSink | rr.FileSink] = []
    if live:
        _reach_viewer(port)
        sinks.append(rr.GrpcSink(f"rerun+http://127.0.0.1:{port}/proxy"))
    try:
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            sinks.append(rr.FileSink(file))
        stream.set_sinks(*sinks)
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{file}: cannot be written ({error}); choose another file with --rerun") from error
    return stream


def _reach_viewer(port: int) -> None:
    """Make sure that a viewer listens."""
    if _listens(port):
        return
    instead = f"record with --rerun FILE.rrd to look at it elsewhere, or let a viewer listen on port {port} here"
    if sys.platform == "linux" and not any(os.environ.get(name) for name in _SCREENS):
        raise ViewerError(f"--viz rerun: there is no screen to open a viewer on; {instead}")
    own = Path(sys.executable).with_name("rerun")  # where an environment that is not activated has it
    program = str(own) if own.is_file() else "rerun"
    # rerun.spawn would do, but its viewer listens to the whole network.
    here_alone = [f"--port={port}", "--bind=127.0.0.1", "--expect-data-soon"]
    try:
        viewer = subprocess.Popen([program, *here_alone], start_new_session=True)  # noqa: S603 - it outlives the run
    except OSError as error:
        raise ViewerError(f"--viz rerun: the viewer cannot be started ({error}); {instead}") from error
    deadline = time.monotonic() + _PATIENCE
    while not _listens(port):
        if viewer.poll() is not None or time.monotonic() > deadline:
            raise ViewerError(f"--viz rerun: no viewer came up, its reason may stand above; {instead}")
        time.sleep(0.2)


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True
