"""Reproduction of the paper's tables and ablation study: a batch on its eight sequences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console, RenderableType

from v3d_torch.batch.batch_folder import STUDY_TABLE
from v3d_torch.batch.batch_record import BatchRecord
from v3d_torch.batch.job import Job
from v3d_torch.batch.plan import check_configs, load_configs, plan_jobs, prepare_stages
from v3d_torch.batch.process_executor import ProcessExecutor
from v3d_torch.batch.runner import check_resume, run_missing_jobs
from v3d_torch.batch.wide_console import wide_console
from v3d_torch.config.loading import FULL
from v3d_torch.datasets import PAPER_SEQUENCES, short_name
from v3d_torch.datasets.locate import data_folder, find_stored
from v3d_torch.datasets.sequence_names import download_url
from v3d_torch.errors import DownloadError, InputError
from v3d_torch.evaluation import ablation
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.evaluation.summary import LEGEND
from v3d_torch.evaluation.tables import (
    format_latex_document,
    format_markdown_table,
    make_screen_legend,
    make_screen_table,
)
from v3d_torch.io.files import write_text
from v3d_torch.runs.open_sequences import OpenedSequence, open_sequence
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_folder import lock_results, make_result_folder

TABLE_CONFIGS = (FULL, "paper", "baseline")
"""Default configurations in the paper's tables."""


def run_reproduction(
    config_names: Sequence[str],
    *,
    study: bool,
    seeds: int,
    workers: int | None,
    out: Path | None,
    resume: bool,
    data_root: Path | None,
    download: bool,
) -> None:
    """Run the paper's sequences and fill its tables; arguments as in ``v3d-torch reproduce --help``.

    Raises:
        V3DError: If the input is invalid or no sequence is available (before the first run), if the user interrupted
            the batch, or if a run failed or has incomplete results. The results of the other runs are written.
    """
    check_resume(resume, out)
    console = wide_console()
    one_thread = (workers or 1) > 1
    table_configs = load_configs(config_names, one_thread=one_thread)
    configs = load_configs([*config_names, *(ablation.VARIANTS if study else ())], one_thread=one_thread)
    check_configs(config_names, table_configs)
    opened, missing, reason = _open_paper_sequences(data_root, download, console)
    if missing:
        advice = describe_missing(missing, data_folder(data_root), reason)
        if not opened:
            raise InputError(advice)
        print_line(console, advice)
    prepare_stages(configs)
    folder = make_result_folder(out, "reproduce")
    jobs = plan_jobs(opened, configs, seeds=seeds, folder=folder)
    absent = list(map(short_name, missing))
    with lock_results(folder):
        record = ReproductionRecord(jobs, folder.absolute(), list(table_configs), absent, study=study)
        run_missing_jobs(record, ProcessExecutor(workers or 1), console, resume=resume)


class ReproductionRecord(BatchRecord):
    """Outcomes of a reproduction, as the paper's tables and as its ablation study.

    Args:
        jobs: All jobs.
        folder: Folder of the results.
        table_configs: Names of the configurations in the paper's tables; the others appear in the study only.
        absent: Sequences of the paper that are not available; they have a row without values in the tables.
        study: True to include the ablation study.

    Raises:
        InputError: If a complete run in the folder has another configuration or another sequence.
    """

    def __init__(
        self, jobs: Sequence[Job], folder: Path, table_configs: Sequence[str], absent: Sequence[str], *, study: bool
    ) -> None:
        super().__init__(jobs, folder, table_configs=table_configs, absent=absent)
        self._study = study

    @property
    def _study_outcomes(self) -> list[Outcome]:
        """Outcomes of the study, ordered by variant, sequence and seed."""
        variants = ablation.VARIANTS if self._study else ()
        return [outcome for variant in variants for outcome in self.outcomes if outcome.config == variant]

    def write_summaries(self) -> None:
        """Write the paper's tables and those of the study.

        Raises:
            OutputError: If the folder is not writable or the disk is full.
        """
        super().write_summaries()
        if (table := ablation.make_overview_table(self._study_outcomes, self._absent)) is not None:
            document = [
                ablation.format_markdown(self._study_outcomes),
                *format_markdown_table(table),
                "",
                ablation.RATIO_LEGEND,
            ]
            legend = f"{LEGEND} {ablation.RATIO_LEGEND}"
            write_text(self.folder / "ablation.md", "\n".join(document) + "\n")
            write_text(self.folder / "ablation.tex", format_latex_document([table], legend))
            write_text(self.folder / STUDY_TABLE, ablation.format_csv(self._study_outcomes))

    def screen_tables(self) -> list[RenderableType]:
        """Return the paper's tables and that of the study for the screen, and their explanations."""
        shown = super().screen_tables()
        if (table := ablation.make_overview_table(self._study_outcomes, self._absent)) is not None:
            shown += [make_screen_table(table), make_screen_legend(ablation.RATIO_LEGEND)]
        return shown


def describe_missing(missing: Sequence[str], folder: Path, reason: str | None) -> str:
    """Return a message with the missing sequences and how to download them by hand.

    Args:
        missing: Full names of the missing sequences, at least one.
        folder: Folder of named sequences.
        reason: Reason why the download failed; None if no download was tried.
    """
    server = download_url(missing[0]).rpartition("/")[0]
    cause = f" ({reason})" if reason is not None else ""
    return (
        f"missing sequences: {', '.join(missing)}{cause}; download the .tgz of each from {server}/, unpack it and move"
        f" the folder to {folder}"
    )


def _open_paper_sequences(
    data_root: Path | None, download: bool, console: Console
) -> tuple[dict[str, OpenedSequence], list[str], str | None]:
    """Open the paper's sequences that are available.

    Returns:
        Opened sequences by short name; full names of the missing ones; reason of the first failed download, None if no
        download failed.

    Raises:
        InputError: If a sequence or its ground truth is damaged.
    """
    opened: dict[str, OpenedSequence] = {}
    missing: list[str] = []
    reason: str | None = None
    for full_name in PAPER_SEQUENCES:
        name = short_name(full_name)
        if not download and find_stored(name, data_root) is None:
            missing.append(full_name)
            continue
        request = RunRequest.of_sequence(name, data_root)
        try:
            sequence = open_sequence(request, console)
        except DownloadError as error:
            missing.append(full_name)
            reason = reason or str(error.__cause__ or error)
        else:
            opened[name] = OpenedSequence(request, sequence)
    return opened, missing, reason
