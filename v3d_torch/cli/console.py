"""What the commands that run sequences show: progress, verdicts, scores, errors in one sentence."""

from __future__ import annotations

import os
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence, Sized
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from threading import Event
from types import FrameType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from v3d_torch.config import Config
from v3d_torch.datasets import RGBDSequence, RGBDStream, load_sequence
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import GroundTruthWarning, InputError, OutputError, V3DError
from v3d_torch.evaluation import Evaluation
from v3d_torch.mapping.map_io import StoredMap
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.checkpoint import Checkpoint
from v3d_torch.runs.logged_run import describe_motion, log_to, run_logged
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_folder import prepare_folder
from v3d_torch.types import RGBDFrame, Segmenter, TrackingStatus
from v3d_torch.viz.viewer import NULL_VIEWER, Viewer


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Turn an error that the user can act on into one sentence on stderr and exit code 2."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GroundTruthWarning)  # commands say it themselves, after the results
            yield
    except V3DError as error:
        print(f"error: {_printable(error)}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:  # of a path that the user gave: its name is too long, its folder may not be looked into
        where, why = error.filename or "a file", error.strerror or error
        print(f"error: {_printable(where)}: cannot be used ({why}); check the path and who may use it", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("error: interrupted before the results were written", file=sys.stderr)
        sys.exit(2)


def _printable(what: object) -> str:
    """A message on one line: names and lines of files are part of it, and may hold what a terminal obeys."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(what))


def open_sequence(name: str, data_root: Path | None, camera: str | None, console: Console) -> RGBDSequence:
    """`load_sequence`, with a bar where that takes a while."""
    with progress_bars(console) as progress:
        return load_sequence(name, data_root=data_root, camera=camera, progress=ProgressBar(progress, "sequence"))


def open_sequences(names: Sequence[str], data_root: Path | None, console: Console) -> dict[str, RGBDSequence]:
    """Open several by their names in tables, in the order given, before the first of them runs.

    Raises:
        InputError: one is wrong, or two have the same name.
        DownloadError: one is not here and cannot be downloaded.
    """
    sequences: dict[str, RGBDSequence] = {}
    for name in dict.fromkeys(names):
        sequence = open_sequence(name, data_root, None, console)
        if isinstance(sequence, StoredSequence) and sequence.groundtruth_error is not None:
            raise sequence.groundtruth_error  # runs that are compared are compared by their scores
        if sequence.name in sequences:
            raise InputError(f"{name}: another sequence is called {sequence.name} too; give each once, or them apart")
        sequences[sequence.name] = sequence
    return sequences


def wide_console() -> Console:
    """For tables: a log or a pipe has no width, there they are not squeezed into 80 columns."""
    return Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 200)


def track(
    sequence: RGBDStream,
    segment: Segmenter,
    config: Config,
    folder: Path,
    console: Console,
    *,
    save_masks: bool = False,
    viewer: Viewer = NULL_VIEWER,
    known: StoredMap | None = None,
    request: RunRequest | None = None,
    checkpoint: Checkpoint | None = None,
) -> tuple[Pipeline, Evaluation | None]:
    """`run_logged` with a bar on a console and a log in the folder; see there for arguments, results and errors."""
    total = len(sequence) if isinstance(sequence, Sized) else None
    if checkpoint is None:
        prepare_folder(folder)
    log = log_to(folder / "run.log", append=checkpoint is not None)
    with progress_bars(console) as progress, interrupts_between_frames() as interrupted, log:
        show = _Verdicts(progress, total, interrupted, done=0 if checkpoint is None else checkpoint.frames)
        pipeline, evaluation = run_logged(
            sequence,
            segment,
            config,
            folder,
            show,
            save_masks=save_masks,
            viewer=viewer,
            known=known,
            request=request,
            checkpoint=checkpoint,
        )
    pipeline.record.interrupted |= interrupted.is_set()  # also when the frames were done, and the results were written
    return pipeline, evaluation


def progress_bars(console: Console) -> Progress:
    """Bars with counts, the time left and a note; none where nobody watches."""
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
    """A bar for a job that reports (done, total), such as a download."""

    def __init__(self, progress: Progress, what: str) -> None:
        self._progress, self._what = progress, what
        self._task: TaskID | None = None

    def __call__(self, done: int, total: int | None) -> None:
        """Show how far the job is."""
        if self._task is None:
            self._task = self._progress.add_task(self._what, note="")
        self._progress.update(self._task, completed=done, total=total)


class _Verdicts:
    """The bar of a run: frames a second, and what the objects in view are judged to be."""

    def __init__(self, progress: Progress, frames: int | None, interrupted: Event, done: int) -> None:
        self._progress = progress
        self._interrupted = interrupted
        self._task = progress.add_task("tracking", total=frames, completed=done, note="getting ready")
        self._first: float | None = None
        self._since = 0

    def __call__(self, frame: RGBDFrame, scene: FrameObjects, status: TrackingStatus) -> None:
        now, note = time.perf_counter(), f"{status.value}  {describe_motion(scene)}"
        if self._first is None:
            self._first = now
        else:
            self._since += 1
            note = f"{self._since / (now - self._first):.1f} frames/s  {note}"
        self._progress.update(self._task, advance=1, note=note)
        if self._interrupted.is_set():
            raise KeyboardInterrupt


@contextmanager
def interrupts_between_frames() -> Iterator[Event]:
    """Hold Ctrl-C back until a frame is done, so that the map is whole; a second one strikes at once."""
    interrupted = Event()

    def hold(signum: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()

    before = signal.signal(signal.SIGINT, hold)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)


def result_folder(out: Path | None, name: str) -> Path:
    """The folder given, made if need be, else a new one by the time, which ``latest`` beside it points to."""
    runs = Path("results") / name.replace("/", "_")
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            return out
        folder = _folder_of_now(runs)
    except OSError as error:
        raise OutputError(
            f"{out or runs}: cannot be made ({error.strerror}); choose another folder with --out"
        ) from error
    pointer = runs / f".latest.{os.getpid()}"  # renamed, so that there is always a latest
    with suppress(OSError):  # no links on Windows without developer mode, nor on some disks: the run goes without
        pointer.symlink_to(folder.name)
        pointer.replace(runs / "latest")
    return folder


def _folder_of_now(runs: Path) -> Path:
    """A new folder by the time, to the second; of runs that begin in the same one, each has its own."""
    runs.mkdir(parents=True, exist_ok=True)
    now = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    folder, others = runs / now, 0
    while True:
        try:
            folder.mkdir()
        except FileExistsError:
            others += 1
            folder = runs / f"{now}_{others + 1}"
        else:
            return folder
