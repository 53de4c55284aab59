"""The paper's tables and its ablation study, made anew: its eight sequences through the runner of batches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from v3d_torch.batch.job import Job
from v3d_torch.batch.plan import make_sure_of_networks, plan, read_configs
from v3d_torch.batch.processes import Processes
from v3d_torch.batch.records import BatchRecord
from v3d_torch.batch.runner import complete, refuse_resume_of_nothing
from v3d_torch.config.loading import FULL
from v3d_torch.datasets import PAPER_SEQUENCES, RGBDSequence, short_name
from v3d_torch.datasets.locate import data_folder, stored_path
from v3d_torch.datasets.sequence_names import download_url
from v3d_torch.errors import DownloadError, InputError
from v3d_torch.evaluation import ablation
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.evaluation.summary import LEGEND, PACKAGES, csv_text, latex, markdown, screen_tables
from v3d_torch.evaluation.tables import latex_table, markdown_table, screen_table
from v3d_torch.io.files import write_text
from v3d_torch.runs.console import open_sequence, wide_console
from v3d_torch.runs.result_folder import make_result_folder

CONFIGS = (FULL, "paper", "baseline")
"""Whose scores stand in the paper's tables."""


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
    """Run the paper's sequences and fill its tables; see ``python -m v3d_torch reproduce --help``.

    Raises:
        V3DError: on bad input or where no sequence is here, before the first run; or when the user interrupted or a run
            failed. What the others gave is written.
    """
    refuse_resume_of_nothing(resume, out)
    console = wide_console()
    one_thread = (workers or 1) > 1
    shown = read_configs(config_names, one_thread=one_thread)
    configs = read_configs([*config_names, *(ablation.VARIANTS if study else ())], one_thread=one_thread)
    opened, absent, reason = _open_all(data_root, download, console)
    if absent:
        advice = how_to_get(absent, data_folder(data_root), reason)
        if not opened:
            raise InputError(advice)
        console.print(advice, markup=False)
    make_sure_of_networks(configs)
    folder = make_result_folder(out, "reproduce")
    sequences = {name: (name, sequence) for name, sequence in opened.items()}
    jobs = plan(sequences, configs, seeds=seeds, data_root=data_root, folder=folder)
    record = Reproduction(jobs, folder.absolute(), list(shown), list(map(short_name, absent)), study=study)
    complete(record, Processes(workers or 1), console, resume=resume)


class Reproduction(BatchRecord):
    """The outcomes of the runs, as the paper's tables and as its ablation study.

    Args:
        jobs: all runs.
        folder: of the results.
        configs: that stand in the paper's tables; others are of the study alone.
        absent: sequences of the paper that nothing can be run on.
        study: whether there is an ablation study.

    Raises:
        InputError: a finished run in the folder has another configuration.
    """

    def __init__(
        self, jobs: Sequence[Job], folder: Path, configs: Sequence[str], absent: Sequence[str], *, study: bool
    ) -> None:
        super().__init__(jobs, folder)
        self._configs = configs
        self._absent = absent
        self._study = study

    @property
    def _in_tables(self) -> list[Outcome]:
        return [outcome for outcome in self.outcomes if outcome.config in self._configs]

    @property
    def _in_study(self) -> list[Outcome]:
        """In the order of the variants, by sequence and then by seed as they were planned."""
        variants = ablation.VARIANTS if self._study else ()
        return [outcome for variant in variants for outcome in self.outcomes if outcome.config == variant]

    def summarise(self) -> None:
        """Write the paper's tables, and those of the study.

        Raises:
            OutputError: when the folder cannot be written or the disk is full.
        """
        write_text(self.folder / "summary.md", markdown(self._in_tables, self._absent))
        write_text(self.folder / "summary.tex", latex(self._in_tables, self._absent))
        write_text(self.folder / "summary.csv", csv_text(self._in_tables, self._absent))
        if (table := ablation.overview(self._in_study, self._absent)) is not None:
            document = [ablation.markdown(self._in_study), *markdown_table(table), "", ablation.TIMES_FULL]
            legend = f"{LEGEND} {ablation.TIMES_FULL}"
            write_text(self.folder / "ablation.md", "\n".join(document) + "\n")
            write_text(self.folder / "ablation.tex", "\n".join([PACKAGES, *latex_table(table, legend)]) + "\n")
            write_text(self.folder / "ablation.csv", ablation.csv_text(self._in_study))

    def tables(self) -> list[Table]:
        """The same for the screen."""
        table = ablation.overview(self._in_study, self._absent)
        return [*screen_tables(self._in_tables, self._absent), *([screen_table(table)] if table is not None else [])]


def how_to_get(absent: Sequence[str], folder: Path, reason: str | None) -> str:
    """The sentence that says which sequences are not here and how to get them by hand.

    Args:
        absent: their full names, at least one.
        folder: that they are looked for in.
        reason: why they could not be downloaded; None where that was not tried.
    """
    server = download_url(absent[0]).rpartition("/")[0]
    why = f" ({reason})" if reason is not None else ""
    return (
        f"not here: {', '.join(absent)}{why}; get the .tgz of each from {server}/, unpack it and put the folder into"
        f" {folder}"
    )


def _open_all(
    data_root: Path | None, download: bool, console: Console
) -> tuple[dict[str, RGBDSequence], list[str], str | None]:
    """The paper's sequences by their short names, the full names of those that are not here, and why the first is not.

    Raises:
        InputError: one that is here is broken.
    """
    opened: dict[str, RGBDSequence] = {}
    absent: list[str] = []
    reason: str | None = None
    for full_name in PAPER_SEQUENCES:
        name = short_name(full_name)
        if not download and stored_path(name, data_root) is None:
            absent.append(full_name)
            continue
        try:
            opened[name] = open_sequence(name, data_root, None, console)
        except DownloadError as error:
            absent.append(full_name)
            reason = reason or str(error.__cause__ or error)
    return opened, absent, reason
