"""Heading of a measurement: command, commit, date, hardware and versions."""

from __future__ import annotations

import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import v3d_torch

LIBRARIES = ("torch", "kornia", "onnxruntime")


@dataclass(frozen=True)
class Heading:
    """Circumstances of a measurement.

    Attributes:
        command: Command line that measured; empty if it is not recorded.
        commit: Commit of the package.
        date: Date of the measurement, ISO 8601.
        hardware: Processor, number of cores and load.
        versions: Versions of Python and the libraries; empty if they are not recorded.
    """

    command: str
    commit: str
    date: str
    hardware: str
    versions: str = ""

    def until_now(self) -> Heading:
        """Name both commits if the checkout has changed since the start: each run imports the package anew."""
        commit = current_commit()
        return self if commit == self.commit else replace(self, commit=f"{self.commit} to {commit}")

    def lines(self) -> Iterator[str]:
        """Yield the heading as lines of Markdown."""
        if self.command:
            yield f"`{self.command}`"
            yield ""
        yield f"- commit {self.commit}, {self.date}"
        yield f"- {self.hardware}"
        if self.versions:
            yield f"- {self.versions}"


def make_heading(peers: tuple[str, ...] = ()) -> Heading:
    """Describe this process. Call it before the first run, so that the load excludes the benchmark.

    Args:
        peers: Further packages whose versions to record.
    """
    return Heading(
        command=shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]),
        commit=current_commit(),
        date=f"{datetime.now().astimezone():%Y-%m-%d}",
        hardware=f"{processor()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before the first run",
        versions=", ".join([f"Python {platform.python_version()}", *map(installed, (*LIBRARIES, *peers))]),
    )


def installed(name: str) -> str:
    """Return name and version of a package."""
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} not installed"


def current_commit() -> str:
    """Return the commit of the package's checkout, with ``-dirty`` if tracked files differ from it."""
    # --exclude: the hash even if there is a tag. No optional locks: another process may be committing.
    command = ["git", "--no-optional-locks", "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        folder = Path(v3d_torch.__file__).parent
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()  # noqa: S603
    except (OSError, subprocess.CalledProcessError):
        return "unknown (not a git checkout)"


def processor() -> str:
    """Return the model of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    match = re.search(r"^model name\s*: (.+)$", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.is_file() else None
    return match[1] if match else platform.processor() or platform.machine()
