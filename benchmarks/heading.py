"""What stands above every table: what was run, of which commit, when and on what."""

from __future__ import annotations

import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import v3d_torch

LIBRARIES = ("torch", "kornia", "onnxruntime")


def heading(peers: tuple[str, ...] = ()) -> Iterator[str]:
    """Lines of Markdown; to be asked for before the first run, whose load is in it.

    Args:
        peers: packages whose versions are told, too.
    """
    yield f"`{shlex.join(['python', f'benchmarks/{Path(sys.argv[0]).name}', *sys.argv[1:]])}`"
    yield ""
    yield f"- commit {commit()}, {datetime.now().astimezone():%Y-%m-%d}"
    yield f"- {processor()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before the first run"
    yield f"- Python {platform.python_version()}, " + ", ".join(map(installed, (*LIBRARIES, *peers)))


def installed(name: str) -> str:
    """Name and version of a package."""
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} not installed"


def commit() -> str:
    """Of the package's checkout, with ``-dirty`` when tracked files differ from it."""
    # --exclude: no tag instead of the hash. No optional locks: someone may be about to commit.
    command = ["git", "--no-optional-locks", "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        folder = Path(v3d_torch.__file__).parent
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()  # noqa: S603
    except (OSError, subprocess.CalledProcessError):
        return "unknown (not a git checkout)"


def processor() -> str:
    """Model of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*: (.+)$", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.is_file() else None
    return found[1] if found else platform.processor() or platform.machine()
