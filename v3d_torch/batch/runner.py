"""Runner of a batch: planning, execution, display and summary tables."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from rich.console import Console

from v3d_torch.batch.batch_folder import has_batch, has_study_only
from v3d_torch.batch.batch_record import BatchRecord
from v3d_torch.batch.executor import Executor, JobFinished, JobRepeated
from v3d_torch.batch.plan import check_configs, load_configs, plan_jobs, prepare_stages
from v3d_torch.batch.process_executor import ProcessExecutor
from v3d_torch.batch.progress import BatchProgress
from v3d_torch.batch.ray_executor import RayExecutor
from v3d_torch.batch.wide_console import wide_console
from v3d_torch.datasets.sequence_patterns import matching_sequences
from v3d_torch.errors import InputError, OutputError, RunError
from v3d_torch.runs.interrupts import interrupts_between_frames
from v3d_torch.runs.kernel_compilation import compile_with_progress
from v3d_torch.runs.open_sequences import open_sequences
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.progress_bar import progress_bars
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_folder import check_unlocked, lock_results, make_result_folder


def run_batch(
    patterns: Sequence[str],
    config_names: Sequence[str],
    *,
    seeds: int,
    workers: int | None,
    out: Path | None,
    resume: bool,
    data_root: Path | None,
    camera: str | None,
    fps: float | None,
    ray: str | None,
    skip_broken: bool,
) -> None:
    """Run every sequence with every configuration and seed; arguments as in ``v3d-torch batch --help``.

    Raises:
        V3DError: If the input is invalid (before the first run), if the batch was interrupted, or if a run failed or
            has incomplete results. The results of the other runs are written.
    """
    check_resume(resume, out)
    console = wide_console()
    configs = load_configs(config_names, one_thread=ray is not None or (workers or 1) > 1)
    check_configs(config_names, configs)
    matches = matching_sequences(patterns, data_root)
    for note in matches.notes:
        print_line(console, f"note: {note}")
    executor: Executor = ProcessExecutor(workers or 1) if ray is None else RayExecutor(ray, workers)
    requests = [
        RunRequest.of_sequence(seq, data_root, camera=camera, fps=fps, skip_broken=skip_broken)
        for seq in matches.sequences
    ]
    sequences = open_sequences(requests, console)
    prepare_stages(configs)
    folder = make_result_folder(out, "batch")
    jobs = plan_jobs(sequences, configs, seeds=seeds, folder=folder)
    with lock_results(folder):
        advice = "" if skip_broken else ", with --skip-broken if broken frames ended them"
        run_missing_jobs(BatchRecord(jobs, folder.absolute()), executor, console, resume=resume, advice=advice)


def check_resume(resume: bool, out: Path | None) -> None:
    """Check that the folder of a batch that is to be resumed is given.

    Raises:
        InputError: If it is not given, or is not that of a batch.
        LockedError: If another batch is writing to it, which may not have written its tables yet.
    """
    if not resume:
        return
    if out is None:
        raise InputError("--resume: no folder to resume; pass the folder of the batch with --out")
    check_unlocked(out)
    if not has_batch(out):
        cause = "has no runs of a batch" if out.is_dir() else "is not a folder"
        raise InputError(f"{out}: {cause}; pass the folder of the batch with --out, or start it without --resume")


def run_missing_jobs(
    record: BatchRecord, executor: Executor, console: Console, *, resume: bool, advice: str = ""
) -> None:
    """Run the jobs of a batch that have no outcome yet; show the progress and write the tables.

    Args:
        record: Outcomes of the batch so far.
        executor: Executor of the jobs.
        console: Console for the progress, and for the tables at the end.
        resume: True if the folder can contain complete runs; they are not run again.
        advice: End of the message on failed runs: how to repeat them other than with --resume.

    Raises:
        V3DError: If the folder contains runs or an ablation study, or its tables have runs that are not jobs of this
            batch, or it is not writable; if the user interrupted the batch, or if a run failed or has incomplete
            results.
    """
    folder = record.folder
    if has_study_only(folder):  # times and memory of its runs are not those of single runs
        raise InputError(f"{folder}: contains an ablation study; choose another folder with --out")
    if record.outcomes and not resume:
        raise InputError(
            f"{folder}: contains runs of an earlier batch; continue it with --resume, or choose another folder"
        )
    if unplanned := record.unplanned:
        raise InputError(
            f"{folder}: the tables have runs of other sequences, configurations or seeds, such as {unplanned[0]}; give"
            " all of them with --resume, or choose another folder with --out"
        )
    record.write()  # a folder that is not writable is an error before the first run
    compile_with_progress(console)  # once, and not in each worker
    interrupted = _run(record, executor, console)
    for table in record.screen_tables():
        console.print(table)
    for heading, outcomes in (("failed:", record.failed), ("incomplete:", record.incomplete)):
        if outcomes:
            console.print(heading)
        for outcome in outcomes:
            print_line(console, str(outcome))
    print_line(console, f"results: {folder}")
    total, failed, incomplete = len(record.jobs), len(record.failed), len(record.incomplete)
    if interrupted and (failed or record.missing):
        done = len(record.outcomes) - failed
        raise RunError(
            f"interrupted with {done} of {total} runs done; repeat the command with --resume to run the others"
        )
    if failed:
        raise RunError(f"{failed} of {total} runs failed; repeat the command with --resume to run them again{advice}")
    if incomplete:
        raise RunError(f"{incomplete} of {total} runs have incomplete results; the causes are above")


def _run(record: BatchRecord, executor: Executor, console: Console) -> bool:
    """Run the missing jobs and update the tables after each.

    Returns:
        True if the user interrupted the batch.

    Raises:
        RunError: If the user interrupted it twice.
        OutputError: If the tables cannot be written.
    """
    write_error: OutputError | None = None
    with progress_bars(console) as progress, interrupts_between_frames() as stop:
        show = BatchProgress(progress, record.jobs, record.missing)
        try:
            with closing(executor(record.missing, stop)) as events:
                for event in events:
                    show(event)
                    if isinstance(event, JobRepeated):
                        print_line(progress.console, str(event))
                    if isinstance(event, JobFinished):
                        outcome = record.add(event)
                        print_line(progress.console, str(outcome))
                        for warning in outcome.warnings:
                            print_line(progress.console, f"warning: {warning}")
                        if console.is_terminal and (table := record.progress_table()) is not None:
                            show.show_table(table)
                        try:
                            record.write()
                        except OutputError as error:  # the running jobs can still finish
                            write_error = error
                            stop.set()
        except KeyboardInterrupt as interrupt:
            raise RunError(
                "interrupted twice: the running jobs were killed; repeat the command with --resume to continue"
            ) from interrupt
    if write_error is not None:
        raise OutputError(f"{write_error}; then repeat the command with --resume to continue") from write_error
    return stop.is_set()
