"""A batch from its names to its tables, with everything shown and written."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from rich.console import Console

from v3d_torch.batch.executor import Executor, Finished
from v3d_torch.batch.plan import make_sure_of_networks, plan, read_configs
from v3d_torch.batch.processes import Processes
from v3d_torch.batch.progress import BatchProgress
from v3d_torch.batch.ray_cluster import RayCluster
from v3d_torch.batch.records import BatchRecord
from v3d_torch.datasets.sequence_patterns import matching_sequences
from v3d_torch.errors import InputError, OutputError
from v3d_torch.runs.console import interrupts_between_frames, open_sequences, progress_bars, wide_console
from v3d_torch.runs.result_folder import make_result_folder


def run_batch(
    patterns: Sequence[str],
    config_names: Sequence[str],
    *,
    seeds: int,
    workers: int | None,
    out: Path | None,
    resume: bool,
    data_root: Path | None,
    ray: str | None,
) -> None:
    """Run every sequence with every configuration and seed; see ``python -m v3d_torch batch --help``.

    Raises:
        V3DError: on bad input, before the first run; or when the batch was interrupted or a run failed. What the others
            gave is written.
    """
    refuse_resume_of_nothing(resume, out)
    console = wide_console()
    configs = read_configs(config_names, one_thread=ray is not None or (workers or 1) > 1)
    names = matching_sequences(patterns, data_root)
    executor: Executor = Processes(workers or 1) if ray is None else RayCluster(ray, workers)
    opened = open_sequences(names, data_root, console)
    sequences = {name: (source, opened[name]) for source, name in zip(names, opened, strict=True)}
    make_sure_of_networks(configs)
    folder = make_result_folder(out, "batch")
    record = BatchRecord(plan(sequences, configs, seeds=seeds, data_root=data_root, folder=folder), folder.absolute())
    complete(record, executor, console, resume=resume)


def refuse_resume_of_nothing(resume: bool, out: Path | None) -> None:
    """Raise `InputError` where it is not said which folder to go on in."""
    if resume and out is None:
        raise InputError("--resume: say with --out in which folder to go on")


def complete(record: BatchRecord, executor: Executor, console: Console, *, resume: bool) -> None:
    """Carry out the runs that a record lacks, with everything shown and written.

    Args:
        record: of all runs, in the folder of the results.
        executor: carries them out.
        console: shows how far they are, and the tables at the end.
        resume: whether the folder may hold runs.

    Raises:
        V3DError: the folder holds runs or cannot be written, the user interrupted, or a run failed.
    """
    folder = record.folder
    if record.outcomes and not resume:
        raise InputError(f"{folder}: holds runs of an earlier batch; go on with --resume, or choose another folder")
    record.write()  # a folder that cannot be written is told of now
    interrupted = _carry_out(record, executor, console)
    for table in record.tables():
        console.print(table)
    if record.failed:
        console.print("failed:", *map(str, record.failed), sep="\n", markup=False)
    console.print(f"results: {folder}", markup=False)
    total, failed = len(record.jobs), len(record.failed)
    if interrupted and (failed or record.missing):
        done = len(record.outcomes) - failed
        raise InputError(
            f"interrupted with {done} of {total} runs done; the same command with --resume runs the others"
        )
    if failed:
        raise InputError(f"{failed} of {total} runs failed; the same command with --resume runs them again")


def _carry_out(record: BatchRecord, executor: Executor, console: Console) -> bool:
    """Run what is missing, and write the tables after each run.

    Returns:
        Whether the user ended it.

    Raises:
        InputError: the user ended it at once.
        OutputError: the tables cannot be written.
    """
    lost: OutputError | None = None
    with progress_bars(console) as progress, interrupts_between_frames() as stop:
        bars = BatchProgress(progress, record.jobs, record.missing)
        try:
            with closing(executor(record.missing, stop)) as events:
                for event in events:
                    bars(event)
                    if isinstance(event, Finished):
                        progress.console.print(str(record.add(event)), markup=False)
                        try:
                            record.write()
                        except OutputError as error:  # those under way may still end
                            lost = error
                            stop.set()
        except KeyboardInterrupt as interrupt:
            raise InputError(
                "interrupted twice: what was under way is lost; the same command with --resume goes on"
            ) from interrupt
    if lost is not None:
        raise lost
    return stop.is_set()
