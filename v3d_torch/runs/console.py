"""Runs on the console: progress bar, log file, Ctrl-C between two frames."""

from __future__ import annotations

from collections.abc import Callable, Sized
from functools import partial
from pathlib import Path

from rich.console import Console

from v3d_torch.datasets import RGBDStream
from v3d_torch.evaluation import Evaluation
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.checkpoint import Checkpoint
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.interrupts import interrupts_between_frames
from v3d_torch.runs.kernel_compilation import compile_with_progress
from v3d_torch.runs.log import log_to, show_warnings
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.progress_bar import TrackingBar, progress_bars
from v3d_torch.runs.result_folder import clear_earlier_results, lock_results
from v3d_torch.runs.run import Run


def run_with_progress(
    make_run: Callable[[], Run],
    sequence: RGBDStream,
    folder: Path,
    console: Console,
    checkpoint: Checkpoint | None = None,
) -> tuple[Pipeline, Evaluation | None]:
    """Execute a run with a progress bar on the console and a log file in its folder.

    Args:
        make_run: Function that creates the run; called after the files of an earlier run were removed.
        sequence: Sequence of the run; Ctrl-C stops a live one.
        folder: Folder of the results.
        console: Console for the progress bar.
        checkpoint: Checkpoint that the run resumes from; None if it starts with the first frame.

    Returns:
        The pipeline that ran, and the scores if there is ground truth.

    Raises:
        OutputError: If another run or batch is writing to the folder, or the results cannot be written.
    """
    with lock_results(folder):
        if checkpoint is None:
            clear_earlier_results(folder)
        compile_with_progress(console)
        log = log_to(folder / RunFile.LOG, append=checkpoint is not None)
        warnings = show_warnings(partial(print_line, console))
        with progress_bars(console) as progress, interrupts_between_frames(sequence) as interrupted, log, warnings:
            run = make_run()
            total = len(sequence) if isinstance(sequence, Sized) else None
            done = 0 if checkpoint is None else checkpoint.frames
            evaluation = run(TrackingBar(progress, total, interrupted, done))
        run.pipeline.record.interrupted |= interrupted.is_set()  # includes Ctrl-C while results were written
        return run.pipeline, evaluation
