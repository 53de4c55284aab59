"""Start of the program, without slow imports, so that Ctrl-C, SIGTERM and SIGHUP are reported from the first moment."""

from __future__ import annotations

from v3d_torch.cli.interrupt import exit_on_interrupt, interrupt_on_termination

_INTERRUPTED = 130
"""Exit code of Typer after Ctrl-C, without a message."""


def main() -> None:
    """Import the commands, and call that of the command line."""
    with exit_on_interrupt():
        interrupt_on_termination()
        from v3d_torch.cli.commands import app

        try:
            app(prog_name="v3d-torch")
        except SystemExit as end:
            if end.code == _INTERRUPTED:
                raise KeyboardInterrupt from end
            raise
