"""What the commands that run sequences show: progress, verdicts, scores, errors in one sentence."""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence, Sized
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from threading import Event
from types import FrameType

import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from v3d_torch.config import Config
from v3d_torch.config_file import dump_config, load_config
from v3d_torch.datasets import RGBDSequence, RGBDStream, SourceOptions, load_sequence, open_source
from v3d_torch.earlier_results import clear_results
from v3d_torch.errors import InputError, OutputError, V3DError
from v3d_torch.evaluation import Evaluation
from v3d_torch.evaluation.tables import paper_table
from v3d_torch.files import write_text
from v3d_torch.log_file import LogFile
from v3d_torch.mapping.recorder import Status
from v3d_torch.objects.dynamics import Scene
from v3d_torch.pipeline import Pipeline
from v3d_torch.results import write_results
from v3d_torch.segmentation import make_segmenter
from v3d_torch.segmentation.coco import class_name
from v3d_torch.shortfall import shortfall
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, Segmenter

_LOG = logging.getLogger("v3d_torch")


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Turn an error that the user can act on into one sentence on stderr and exit code 2."""
    try:
        yield
    except V3DError as error:
        print(f"error: {_printable(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("error: interrupted before the results were written", file=sys.stderr)
        sys.exit(2)


def _printable(error: V3DError) -> str:
    """The message on one line: names and lines of files are part of it, and may hold what a terminal obeys."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(error))


def run_sequence(
    name: str,
    *,
    data_root: Path | None,
    camera: str | None,
    options: SourceOptions,
    config_path: Path | None,
    overrides: Sequence[str],
    masks: Path | None,
    weights: Path | None,
    out: Path | None,
    save_masks: bool,
) -> None:
    """Run one sequence with everything shown and written; see ``python -m v3d_torch.run --help``.

    Raises:
        V3DError: on bad input, or when the sequence ended early (the results up to there are written).
    """
    console = Console(soft_wrap=True)
    config = load_config(config_path, overrides)
    with _progress(console) as progress:
        bar = _Bar(progress, "sequence")
        sequence = open_source(name, data_root=data_root, camera=camera, options=options, progress=bar)
    segment = make_segmenter(config.segmentation, weights=weights, masks_dir=masks)
    folder = result_folder(out, sequence.name)
    clear_results(folder)
    write_text(folder / "config.yaml", dump_config(config))  # where this cannot be written, an hour's results cannot
    pipeline, evaluation = track(sequence, segment, config, folder, console, save_masks=save_masks)
    console.print(_summary(pipeline, evaluation))
    if evaluation is not None and (table := paper_table(sequence.name, evaluation)) is not None:
        console.print(table)
    for note in evaluation.notes if evaluation is not None else ():
        console.print(f"note: {note}", markup=False)
    console.print(f"results: {folder}", markup=False)  # brackets in the name are no markup
    if (failure := pipeline.run.failure) is not None:
        done = len(pipeline.slam.poses.statuses)
        raise InputError(f"{failure} (the results of the {done} frames before are in {folder})")
    if (doubt := shortfall(pipeline, evaluation)) is not None:
        raise InputError(f"{doubt} (the results are in {folder})")


def open_sequence(name: str, data_root: Path | None, camera: str | None, console: Console) -> RGBDSequence:
    """`load_sequence`, with a bar where that takes a while."""
    with _progress(console) as progress:
        return load_sequence(name, data_root=data_root, camera=camera, progress=_Bar(progress, "sequence"))


def track(
    sequence: RGBDStream,
    segment: Segmenter,
    config: Config,
    folder: Path,
    console: Console,
    *,
    save_masks: bool = False,
) -> tuple[Pipeline, Evaluation | None]:
    """Run a sequence through a new system, show a bar, and write the log and all results.

    Args:
        sequence: frames.
        segment: gives the instances of a frame.
        config: of the system.
        folder: for the results, there already.
        console: for the bar.
        save_masks: whether to write what is left out of tracking.

    Returns:
        What ran, to the end or until its ``run.failure``, and the scores where there is ground truth.

    Raises:
        OutputError: when the results cannot be written.
    """
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    pipeline = Pipeline(sequence, V3DSLAM(sequence.camera, segment, config), folder / "masks" if save_masks else None)
    with _log_to(folder / "run.log"):
        total = len(sequence) if isinstance(sequence, Sized) else None
        _LOG.info("%s: %s frames", sequence.name, "any number of" if total is None else total)
        with _progress(console) as progress, interrupts_between_frames() as interrupted:
            run = pipeline(_Verdicts(progress, total, interrupted))
        evaluation = write_results(folder, pipeline)
        if run.failure:
            _LOG.error(run.failure)
    return pipeline, evaluation


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        disable=not console.is_terminal,
    )


class _Bar:
    """A bar for a job that reports (done, total), such as a download."""

    def __init__(self, progress: Progress, what: str) -> None:
        self._progress, self._what = progress, what
        self._task: TaskID | None = None

    def __call__(self, done: int, total: int | None) -> None:
        if self._task is None:
            self._task = self._progress.add_task(self._what, note="")
        self._progress.update(self._task, completed=done, total=total)


class _Verdicts:
    """The bar of a run: frames a second, and what the objects in view are judged to be."""

    def __init__(self, progress: Progress, frames: int | None, interrupted: Event) -> None:
        self._progress = progress
        self._interrupted = interrupted
        self._task = progress.add_task("tracking", total=frames, note="")
        self._start = time.perf_counter()
        self._frames = 0

    def __call__(self, frame: RGBDFrame, scene: Scene, status: Status) -> None:
        self._frames += 1
        rate = self._frames / (time.perf_counter() - self._start)
        verdicts = Counter(f"{class_name(judged.label)} {judged.verdict.value}" for judged in scene.objects)
        objects = ", ".join(f"{count} {what}" for what, count in sorted(verdicts.items()) if "static" not in what)
        self._progress.update(self._task, advance=1, note=f"{rate:.1f} frames/s  {status.value}  {objects}")
        _LOG.info("frame %d at %.6f: %s; %s", frame.index, frame.stamp, status.value, objects or "nothing moves")
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
    folder = out or runs / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if out is None:
            pointer = runs / f".latest.{os.getpid()}"  # renamed, so that there is always a latest
            pointer.symlink_to(folder.name)
            pointer.replace(runs / "latest")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another folder with --out") from error
    return folder


@contextmanager
def _log_to(path: Path) -> Iterator[None]:
    handler = LogFile(path)
    _LOG.addHandler(handler)
    _LOG.setLevel(logging.INFO)
    _LOG.propagate = False
    try:
        yield
    except Exception:
        _LOG.exception("the run broke")
        raise
    finally:
        _LOG.removeHandler(handler)
        handler.close()


def _summary(pipeline: Pipeline, evaluation: Evaluation | None) -> Table:
    slam, run = pipeline.slam, pipeline.run
    statuses = Counter(slam.poses.statuses)
    verdicts = Counter(str(row["verdict"]) for row in run.dynamics)
    table = Table(title=f"V3D-SLAM on {escape(pipeline.sequence.name)}", show_header=False)
    table.add_row("frames", f"{len(slam.poses.statuses)} of {pipeline.frames}")
    table.add_row("found", ", ".join(f"{count} {status.value}" for status, count in statuses.items()))
    table.add_row("keyframes, loops", f"{len(slam.mapper.map.keyframes)}, {slam.loops.count}")
    table.add_row("objects judged", ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items()) or "none")
    table.add_row("frames a second", f"{len(slam.poses.statuses) / run.seconds:.1f}" if run.seconds else "-")
    if evaluation is not None:
        table.add_row("ATE rmse", f"{evaluation.ate.rmse:.4f} m (coverage {evaluation.coverage:.0%})")
        if evaluation.rpe is not None:
            table.add_row("RPE rmse", f"{evaluation.rpe.trans.rmse:.4f} m/s, {evaluation.rpe.rot.rmse:.3f} deg/s")
    if (masks := run.mask_evaluation.scores()) is not None:
        shares = {"moving": masks.moving_left_out, "static": masks.static_left_out}
        said = [f"{share:.1%} of the {what} pixels" for what, share in shares.items() if share is not None]
        table.add_row("left out of tracking", ", ".join(said))
        if (changes := masks.id_changes_per_60_frames) is not None:
            table.add_row("ids of people change", f"{changes:.1f} times in 60 frames ({masks.people_found:.0%} found)")
    return table
