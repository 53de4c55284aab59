"""What the commands that run sequences show: progress, verdicts, scores, errors in one sentence."""

from __future__ import annotations

import os
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence, Sized
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from threading import Event
from types import FrameType

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from v3d_torch.config import Config
from v3d_torch.config_file import FULL, find_config, load_config
from v3d_torch.datasets import RGBDSequence, RGBDStream, SourceOptions, load_sequence, open_source
from v3d_torch.datasets.stored import StoredFrames
from v3d_torch.earlier_results import prepare_folder
from v3d_torch.errors import ConfigError, GroundTruthWarning, InputError, OutputError, V3DError
from v3d_torch.evaluation import Evaluation
from v3d_torch.evaluation.tables import paper_table
from v3d_torch.files import refuse_unwritable
from v3d_torch.logged import log_to, run_logged, what_moves
from v3d_torch.mapping.recorder import Status
from v3d_torch.mapping.storage import StoredMap, load_map, save_map
from v3d_torch.objects.dynamics import Scene
from v3d_torch.pipeline import Pipeline
from v3d_torch.segmentation import make_segmenter
from v3d_torch.shortfall import shortfall
from v3d_torch.types import RGBDFrame, Segmenter
from v3d_torch.viz.viewer import NULL_VIEWER, Viewer, make_viewer


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


def run_sequence(
    name: str,
    *,
    data_root: Path | None,
    camera: str | None,
    options: SourceOptions,
    config_name: str | None,
    overrides: Sequence[str],
    masks: Path | None,
    weights: Path | None,
    out: Path | None,
    save_masks: bool,
    viz: str | None,
    rerun_file: Path | None,
    map_in: Path | None,
    map_out: Path | None,
) -> None:
    """Run one sequence with everything shown and written; see ``python -m v3d_torch.run --help``.

    Raises:
        V3DError: on bad input, or when the sequence ended early (the results up to there are written).
    """
    console = Console(soft_wrap=True)
    config = load_config(find_config(config_name or FULL), overrides)
    if map_out is not None:
        refuse_unwritable(map_out)
    if map_in is None and not config.mapping.enabled:
        raise ConfigError("mapping.enabled=false: there is no map to find the camera in; give one with --load-map")
    with progress_bars(console) as progress:
        bar = _Bar(progress, "sequence")
        sequence = open_source(name, data_root=data_root, camera=camera, options=options, progress=bar)
    known = None if map_in is None else load_map(map_in, sequence.camera, config)
    segment = make_segmenter(config.segmentation, weights=weights, masks_dir=masks)
    viewer = make_viewer(viz, rerun_file, sequence)
    folder = result_folder(out, sequence.name)
    if masks is not None and masks.resolve() == (folder / "masks").resolve():
        raise OutputError(f"{masks}: would be written to while it is read; choose another folder with --out")
    pipeline, evaluation = track(
        sequence, segment, config, folder, console, save_masks=save_masks, viewer=viewer, known=known
    )
    if map_out is not None:
        save_map(map_out, pipeline.slam.mapper.map, pipeline.views)
    console.print(_summary(pipeline, evaluation))
    if evaluation is not None and (table := paper_table(sequence.name, evaluation)) is not None:
        console.print(table)
    for note in evaluation.notes if evaluation is not None else ():
        console.print(f"note: {note}", markup=False)
    console.print(f"results: {folder}", markup=False)  # brackets in the name are no markup
    if (failure := pipeline.run.failure) is not None:
        done = len(pipeline.slam.poses.statuses)
        raise InputError(f"{failure} (the results of the {done} frames before are in {folder})")
    if known is not None and not pipeline.slam.poses.located:
        raise InputError(f"{map_in}: no frame of {name} shows a place of this map; its results are in {folder}")
    if (doubt := shortfall(pipeline, evaluation)) is not None:
        raise InputError(f"{doubt} (the results are in {folder})")


def open_sequence(name: str, data_root: Path | None, camera: str | None, console: Console) -> RGBDSequence:
    """`load_sequence`, with a bar where that takes a while."""
    with progress_bars(console) as progress:
        return load_sequence(name, data_root=data_root, camera=camera, progress=_Bar(progress, "sequence"))


def open_sequences(names: Sequence[str], data_root: Path | None, console: Console) -> dict[str, RGBDSequence]:
    """Open several by their names in tables, in the order given, before the first of them runs.

    Raises:
        InputError: one is wrong, or two have the same name.
        DownloadError: one is not here and cannot be downloaded.
    """
    sequences: dict[str, RGBDSequence] = {}
    for name in dict.fromkeys(names):
        sequence = open_sequence(name, data_root, None, console)
        if isinstance(sequence, StoredFrames) and sequence.groundtruth_error is not None:
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
) -> tuple[Pipeline, Evaluation | None]:
    """`run_logged` with a bar on a console and a log in the folder; see there for arguments, results and errors."""
    total = len(sequence) if isinstance(sequence, Sized) else None
    prepare_folder(folder)
    with progress_bars(console) as progress, interrupts_between_frames() as interrupted, log_to(folder / "run.log"):
        show = _Verdicts(progress, total, interrupted)
        pipeline, evaluation = run_logged(
            sequence, segment, config, folder, show, save_masks=save_masks, viewer=viewer, known=known
        )
    pipeline.run.interrupted |= interrupted.is_set()  # also when the frames were done, and the results were written
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
        note = f"{rate:.1f} frames/s  {status.value}  {what_moves(scene)}"
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


def _summary(pipeline: Pipeline, evaluation: Evaluation | None) -> Table:
    slam, run = pipeline.slam, pipeline.run
    statuses = Counter(slam.poses.statuses)
    verdicts = Counter(str(row["verdict"]) for row in run.dynamics)
    table = Table(title=f"V3D-SLAM on {escape(pipeline.sequence.name)}", show_header=False)
    table.add_row("frames", f"{len(slam.poses.statuses)} of {pipeline.frames}")
    table.add_row("found", ", ".join(f"{count} {status.value}" for status, count in statuses.items()))
    earlier = sum(keyframe.known for keyframe in slam.mapper.map.keyframes)
    table.add_row("keyframes, loops", f"{len(slam.mapper.map.keyframes) - earlier}, {slam.loops.count}")
    if earlier:
        table.add_row("known map", f"{earlier} keyframes")
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
