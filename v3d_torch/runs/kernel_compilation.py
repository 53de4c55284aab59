"""Compilation of the kernels with a progress bar, before the first frame."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import ExitStack

from rich.console import Console

from v3d_torch.kernels import compiler
from v3d_torch.runs.progress_bar import ProgressBar, progress_bars
from v3d_torch.runtime.imports import import_environment


def compile_with_progress(console: Console) -> None:
    """Load the compiled kernels, or compile them with a progress bar, which takes half a minute once."""
    bar = None
    with progress_bars(console) as progress, ExitStack() as resources:
        for compiled, left in compiler.compile_kernels():
            if compiled and bar is None:
                console.print("compiling kernels for this processor; this is done once")
                bar, total = ProgressBar(progress, "kernels"), 1 + left
                helper = resources.enter_context(_start_compiling_backwards())  # waits for its end
                resources.callback(helper.kill)
            if bar is not None:
                bar(total - left, total)


def _start_compiling_backwards() -> subprocess.Popen[bytes]:
    """Start a second process that compiles the kernels, starting with the last one, and stores them in the cache."""
    command = "import v3d_torch.slam; from v3d_torch.kernels.compiler import compile_kernels as c; [*c(backwards=True)]"
    return subprocess.Popen(  # noqa: S603 - runs this package
        [sys.executable, "-c", command],
        env=os.environ | import_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
