"""Console of the commands that run sequences: progress bars, errors in one line, Ctrl-C between two frames."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence, Sized
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from threading import Event
from types import FrameType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from v3d_torch.datasets import RGBDSequence, RGBDStream, load_sequence
from v3d_torch.datasets.image_sequence import ImageSequence
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.evaluation import Evaluation
from v3d_torch.frame_result import FrameResult
from v3d_torch.kernels import compiler
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.checkpoint import Checkpoint
from v3d_torch.runs.log import log_to, show_warnings
from v3d_torch.runs.result_folder import clear_earlier_results
from v3d_torch.runs.run import Run, describe_motion
from v3d_torch.types import RGBDFrame


def open_sequence(name: str, data_root: Path | None, console: Console, *, skip_broken: bool = False) -> RGBDSequence:
    """Open a sequence as `load_sequence` does, with a progress bar for downloads."""
    with progress_bars(console) as progress:
        bar = ProgressBar(progress, "sequence")
        sequence = load_sequence(name, data_root=data_root, progress=bar, skip_broken=skip_broken)
    print_assumptions(sequence, console)
    return sequence


def print_assumptions(source: RGBDStream, console: Console) -> None:
    """Print the assumptions about a source that does not state everything: an estimated depth scale."""
    if isinstance(source, ImageSequence) and source.depth_scale_note is not None:
        console.print(f"note: {source.name}: {source.depth_scale_note}", markup=False, highlight=False)


def open_sequences(
    names: Sequence[str], data_root: Path | None, console: Console, *, skip_broken: bool = False
) -> dict[str, RGBDSequence]:
    """Open several sequences in the given order, before the first of them is run; see `load_sequence`.

    Returns:
        Sequences by their name in tables.

    Raises:
        InputError: If a sequence is not valid, or two sequences have the same name.
        DownloadError: If a sequence is missing and cannot be downloaded.
    """
    sequences: dict[str, RGBDSequence] = {}
    for name in dict.fromkeys(names):
        sequence = open_sequence(name, data_root, console, skip_broken=skip_broken)
        if isinstance(sequence, StoredSequence) and sequence.groundtruth_error is not None:
            raise sequence.groundtruth_error  # runs are compared by their scores, so all need readable ground truth
        if sequence.name in sequences:
            raise InputError(f"{name}: another sequence has the same name, {sequence.name}; run them separately")
        sequences[sequence.name] = sequence
    return sequences


def wide_console() -> Console:
    """Return a console for wide tables: 200 columns if the output is not a terminal, instead of 80."""
    return Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 200)


def run_with_progress(
    make_run: Callable[[], Run], folder: Path, console: Console, checkpoint: Checkpoint | None = None
) -> tuple[Pipeline, Evaluation | None]:
    """Execute a run with a progress bar on the console and a log file in its folder.

    Args:
        make_run: Function that creates the run; called after the files of an earlier run were removed.
        folder: Folder of the results.
        console: Console for the progress bar.
        checkpoint: Checkpoint that the run resumes from; None if it starts with the first frame.

    Returns:
        The pipeline that ran, and the scores if there is ground truth.

    Raises:
        OutputError: If the results cannot be written.
    """
    if checkpoint is None:
        clear_earlier_results(folder)
    compile_kernels(console)
    log = log_to(folder / "run.log", append=checkpoint is not None)
    warnings = show_warnings(partial(console.print, markup=False))
    with progress_bars(console) as progress, interrupts_between_frames() as interrupted, log, warnings:
        run = make_run()
        sequence = run.pipeline.sequence
        total = len(sequence) if isinstance(sequence, Sized) else None
        done = 0 if checkpoint is None else checkpoint.frames
        evaluation = run(TrackingBar(progress, total, interrupted, done))
    run.pipeline.record.interrupted |= interrupted.is_set()  # includes Ctrl-C while results were written
    return run.pipeline, evaluation


def compile_kernels(console: Console) -> None:
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
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def progress_bars(console: Console) -> Progress:
    """Return progress bars with counts, remaining time and a note; hidden if the console is not a terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        disable=not console.is_terminal,
    )


class ProgressBar:
    """Progress bar of a job that reports (done, total), such as a download.

    Args:
        progress: Progress bars of the console.
        description: Text to the left of the bar.
    """

    def __init__(self, progress: Progress, description: str) -> None:
        self._progress, self._description = progress, description
        self._task: TaskID | None = None

    def __call__(self, done: int, total: int | None) -> None:
        """Update the bar."""
        if self._task is None:
            self._task = self._progress.add_task(self._description, note="")
        self._progress.update(self._task, completed=done, total=total)


class TrackingBar:
    """Progress bar of a run: frame rate, tracking status and moving objects.

    Args:
        progress: Progress bars of the console.
        frames: Number of frames; None if it is not known.
        interrupted: Event that ends the run after the current frame.
        done: Number of frames that are already tracked.
        description: Text to the left of the bar.
    """

    def __init__(
        self, progress: Progress, frames: int | None, interrupted: Event, done: int = 0, description: str = "tracking"
    ) -> None:
        self._progress = progress
        self._interrupted = interrupted
        self._task = progress.add_task(description, total=frames, completed=done, note="starting")
        self._start: float | None = None
        self._frames = 0

    def __call__(self, frame: RGBDFrame, result: FrameResult) -> None:
        """Update the bar after a frame.

        Raises:
            KeyboardInterrupt: If the run is interrupted.
        """
        now, note = time.perf_counter(), f"{result.status.value}  {describe_motion(result)}"
        if self._start is None:
            self._start = now  # the first frame is not counted, because it waits for the network
        else:
            self._frames += 1
            note = f"{self._frames / (now - self._start):.1f} frames/s  {note}"
        self._progress.update(self._task, advance=1, note=note)
        if self._interrupted.is_set():
            raise KeyboardInterrupt


@contextmanager
def interrupts_between_frames() -> Iterator[Event]:
    """Delay Ctrl-C until the current frame is complete; a second Ctrl-C interrupts at once."""
    interrupted = Event()

    def delay(signum: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()

    previous = signal.signal(signal.SIGINT, delay)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, previous)
