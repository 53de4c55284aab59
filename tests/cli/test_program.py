"""Start of the program: Ctrl-C, SIGTERM or SIGHUP while modules are imported."""

from __future__ import annotations

import subprocess
import sys

import pytest
from helpers.commands import assert_error_line

from v3d_torch.runtime.hangup import handled_hangup

INTERRUPT = """
import os
import signal
import sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            {interrupt}

sys.meta_path.insert(0, Interrupt())
"""
"""Code that interrupts the process when a module is imported."""

CTRL_C = "raise KeyboardInterrupt"  # not a signal, which a process in the background ignores

SIGTERM = "os.kill(os.getpid(), signal.SIGTERM)"

SIGHUP = "os.kill(os.getpid(), signal.SIGHUP)"

PROGRAM = "from v3d_torch.__main__ import main; main()"

MODULE = "import runpy; runpy.run_module('v3d_torch.run', run_name='__main__', alter_sys=True)"


@pytest.mark.parametrize(
    ("start", "arguments"),
    [(PROGRAM, ["run", "--seq", "demo"]), (PROGRAM, ["record", "--out", "out"]), (MODULE, ["--seq", "demo"])],
    ids=["run", "record", "module run"],
)
@pytest.mark.parametrize(
    ("module", "interrupt"),
    [
        ("typer", CTRL_C),
        ("rich.console", CTRL_C),
        ("torch", CTRL_C),
        ("typer", SIGTERM),
        ("torch", SIGTERM),
        pytest.param(
            "torch", SIGHUP, marks=pytest.mark.skipif(not handled_hangup(), reason="SIGHUP is ignored, as by nohup")
        ),
    ],
    ids=["typer", "rich", "torch", "typer, SIGTERM", "torch, SIGTERM", "torch, SIGHUP"],
)
def test_interruption_during_an_import_is_reported_as_later(
    module: str, interrupt: str, start: str, arguments: list[str]
) -> None:
    code = INTERRUPT.format(module=module, interrupt=interrupt) + start
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert_error_line(done, "error: interrupted before the results were written\n")
