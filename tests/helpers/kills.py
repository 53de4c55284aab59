"""Kills of a process by itself at chosen moments, as if the system killed it there."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

from v3d_torch.slam import V3DSLAM


def kill_while_tracking(frame: int) -> None:
    """Kill this process in the middle of the tracking of a frame, counted from 1."""
    _kill_at(V3DSLAM, "_append_pose", frame, lambda *_: True)


def kill_before_renaming(name: str, time: int) -> None:
    """Kill this process when a file is complete under its temporary name, and would be renamed.

    Args:
        name: Name of the file.
        time: Number of times that the file is written, with this one.
    """
    _kill_at(Path, "replace", time, lambda _, target: Path(target).name == name)


def _kill_at(owner: type, method: str, number: int, counts: Callable[..., bool]) -> None:
    """Kill this process in place of a call of a method, the ``number``-th of those that count."""
    original, calls = getattr(owner, method), 0

    def call(*arguments: object) -> object:
        nonlocal calls
        calls += counts(*arguments)
        if calls == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*arguments)

    patch.object(owner, method, call).start()
