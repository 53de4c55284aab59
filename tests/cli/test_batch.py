"""``python -m v3d_torch batch`` as a user calls it: runs apart from each other, tables, --resume, Ctrl-C, bad input."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Sequence
from io import StringIO
from pathlib import Path
from threading import Event

import numpy as np
import pandas as pd
import pytest
from helpers.batches import jobs, repeated
from rich.console import Console
from typer.testing import CliRunner, Result

from v3d_torch.batch import runner as batch_module
from v3d_torch.batch.executor import Finished, JobProgress
from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.batch.plan import read_configs
from v3d_torch.batch.processes import Processes
from v3d_torch.batch.progress import BatchProgress
from v3d_torch.batch.run_table import FIGURES
from v3d_torch.cli.batch import app
from v3d_torch.config.loading import load_config
from v3d_torch.runs.console import progress_bars

FILES = {
    *("trajectory.txt", "keyframes.txt", "groundtruth.txt", "config.yaml", "metrics.json", "run.log"),
    *("frames.parquet", "dynamics.parquet", "map.ply", "trajectory.ply"),
    *("figures/trajectory.png", "figures/masks.png"),
}
"""What every run leaves behind."""

BROKEN_AT = 3


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "v3d_torch", "batch", *map(str, arguments)]


def environment() -> dict[str, str]:
    own = {key: value for key, value in os.environ.items() if key != "V3D_DATA"}
    return own | {"OMP_NUM_THREADS": "1", "NO_COLOR": "1"}


def call(*arguments: str | Path) -> Result:
    """In this process; the runs are in others all the same."""
    return CliRunner().invoke(app, list(map(str, arguments)), env={"V3D_DATA": "", "NO_COLOR": "1"})


def assert_one_sentence(code: int, stderr: str, *words: str | Path) -> None:
    assert code == 2, stderr
    assert stderr.startswith("error: ") and stderr.count("\n") == 1, stderr
    for word in words:
        assert str(word) in stderr


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def metrics_of(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def break_frame(sequence: Path, index: int) -> Path:
    """Cut an image of a copy in half."""
    colour = sorted((sequence / "rgb").iterdir())[index]
    colour.write_bytes(colour.read_bytes()[:1000])
    return colour


@pytest.fixture(scope="module")
def work(moment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two sequences, of which one breaks on the way, and a configuration."""
    folder = tmp_path_factory.mktemp("work")
    for name in ("broken", "good"):
        shutil.copytree(moment, folder / "data" / name)
    break_frame(folder / "data" / "broken", BROKEN_AT)
    (folder / "data" / "notes").mkdir()
    (folder / "few.yaml").write_text("segmentation:\n  source: none\nfeatures:\n  count: 800\n")
    return folder


@pytest.fixture(scope="module")
def done(work: Path) -> subprocess.CompletedProcess[str]:
    """Two sequences by a pattern, two configurations in one option, two at a time; results are in ``out``."""
    arguments = command("--seqs", "*", "--data-root", work / "data", "--configs", "baseline", work / "few.yaml")
    return subprocess.run(  # noqa: S603
        [*arguments, "--workers", "2", "--out", str(work / "out")],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=500,
    )


RUNS = [(sequence, config) for sequence in ("broken", "good") for config in ("baseline", "few")]


# --- a batch


def test_every_run_that_does_not_fail_has_the_files_of_a_run(
    done: subprocess.CompletedProcess[str], work: Path
) -> None:
    for config, file in (("baseline", None), ("few", work / "few.yaml")):
        folder = work / "out" / "good" / config / "seed0"
        assert files_in(folder) == FILES
        overrides = ["segmentation.source=none"] if file is None else []
        assert load_config(folder / "config.yaml") == single_threaded(load_config(file, overrides))
    assert {path.name for path in (work / "out").iterdir()} == {
        *("broken", "good", "runs.parquet", "summary.md", "summary.tex", "summary.csv"),
    }


def test_a_run_that_fails_costs_the_others_nothing_and_is_told_at_the_end(
    done: subprocess.CompletedProcess[str], work: Path
) -> None:
    assert_one_sentence(done.returncode, done.stderr, "2 of 4 runs failed", "--resume")
    image = sorted((work / "data" / "broken" / "rgb").iterdir())[BROKEN_AT]
    lines = done.stdout.splitlines()
    failures = [f"broken, {config}, seed 0: failed: {image}" for config in ("baseline", "few")]
    assert lines[-4] == "failed:"
    for failure, line in zip(failures, lines[-3:-1], strict=True):
        assert line.startswith(failure)
    assert lines[-1] == f"results: {work / 'out'}"
    for config in ("baseline", "few"):
        folder = work / "out" / "broken" / config / "seed0"
        assert files_in(folder) == FILES | {"checkpoint.v3d"}
        assert len((folder / "trajectory.txt").read_text().splitlines()) == BROKEN_AT
        assert str(image) in (folder / "run.log").read_text()
        assert str(image) in metrics_of(folder)["failure"]


def test_nothing_moves_where_nobody_watches(done: subprocess.CompletedProcess[str]) -> None:
    assert "\x1b" not in done.stdout and "all runs" not in done.stdout
    assert sum(line.startswith(("good, ", "broken, ")) for line in done.stdout.splitlines()) == 4 + 2


def test_the_table_has_the_figures_of_each_run(done: subprocess.CompletedProcess[str], work: Path) -> None:
    table = pd.read_parquet(work / "out" / "runs.parquet")
    assert list(zip(table["sequence"], table["config"], strict=True)) == RUNS
    assert (table["seed"] == 0).all()
    for _, row in table.iterrows():
        folder = work / "out" / row["path"]
        assert folder == work / "out" / row["sequence"] / row["config"] / "seed0"
        metrics = metrics_of(folder)
        assert (None if pd.isna(row["failure"]) else row["failure"]) == metrics["failure"]
        for place in FIGURES:
            value: object = metrics
            for key in place.split("."):
                value = value.get(key) if isinstance(value, dict) else None
            cell = row[place.replace(".", "_")]
            if row["sequence"] == "broken" or value is None:
                assert np.isnan(cell), place  # of half a trajectory no figure is taken
            else:
                assert cell == value, place
    good = table[table["sequence"] == "good"]
    assert (good["tracked"] == 6).all() and (good["coverage"] == 1).all() and (good["peak_memory_mb"] > 50).all()
    assert (good["masks_moving_left_out"] == 0).all()  # there is truth, and no masks


def test_the_summaries_have_the_figures_of_the_runs(done: subprocess.CompletedProcess[str], work: Path) -> None:
    ates = {c: metrics_of(work / "out" / "good" / c / "seed0")["ate"]["rmse"] for c in ("baseline", "few")}
    shown = {c: f"**{ate:.4f}**" if ate == min(ates.values()) else f"{ate:.4f}" for c, ate in ates.items()}
    document = (work / "out" / "summary.md").read_text()
    assert f"| good | {shown['baseline']} | {shown['few']} |" in document
    assert "| broken | failed | failed |" in document
    assert "good & " in (work / "out" / "summary.tex").read_text()
    rows = list(csv.DictReader((work / "out" / "summary.csv").open(newline="")))
    medians = {row["method"]: row["median"] for row in rows if (row["metric"], row["sequence"]) == ("ate.rmse", "good")}
    assert {config: float(value) for config, value in medians.items()} == ates


# --- going on


@pytest.fixture(scope="module")
def repaired(done: subprocess.CompletedProcess[str], work: Path) -> tuple[Path, Result, dict[Path, int]]:
    """The batch gone on with, one run at a time, after the broken image came back; with the times of files before."""
    shutil.copytree(work, work.parent / "again", copy_function=shutil.copy2)
    again = work.parent / "again"
    for image in (again / "data" / "good" / "rgb").iterdir():
        shutil.copy2(image, again / "data" / "broken" / "rgb")
    before = {path: path.stat().st_mtime_ns for path in (again / "out" / "good").rglob("*") if path.is_file()}
    result = call(*same(again), "--resume")
    return again, result, before


def same(folder: Path) -> list[str | Path]:
    """The command line of the batch in a folder, without --workers."""
    configs = ("--configs", folder / "few.yaml", "--configs", "baseline")
    return ["--seqs", "good", "--seqs", "broken", *configs, "--data-root", folder / "data", "--out", folder / "out"]


def test_resume_runs_what_failed_and_nothing_else(repaired: tuple[Path, Result, dict[Path, int]]) -> None:
    folder, result, before = repaired
    assert result.exit_code == 0, result.output
    assert {path: path.stat().st_mtime_ns for path in before} == before
    told = [line.split(", seed")[0] for line in result.stdout.splitlines() if ", seed" in line]
    assert told == ["broken, few", "broken, baseline"]
    table = pd.read_parquet(folder / "out" / "runs.parquet")
    order = [(sequence, config) for sequence in ("good", "broken") for config in ("few", "baseline")]
    assert list(zip(table["sequence"], table["config"], strict=True)) == order
    assert table["failure"].isna().all() and (table["tracked"] == 6).all()
    assert "ailed" not in (folder / "out" / "summary.md").read_text()


def test_one_at_a_time_or_two_gives_the_same_bytes(repaired: tuple[Path, Result, dict[Path, int]]) -> None:
    """The repaired sequence has the images of the good one, which was run when two ran at a time."""
    out = repaired[0] / "out"
    for config in ("baseline", "few"):
        for name in ("trajectory.txt", "keyframes.txt", "dynamics.parquet", "map.ply"):
            one, two = (out / sequence / config / "seed0" / name for sequence in ("broken", "good"))
            assert one.read_bytes() == two.read_bytes(), (config, name)


def test_a_batch_that_is_done_is_only_told_again(repaired: tuple[Path, Result, dict[Path, int]]) -> None:
    folder, _, _ = repaired
    start = time.process_time()
    result = call(*same(folder), "--resume", "--workers", "2")  # other threads are no other configuration
    assert result.exit_code == 0 and ", seed" not in result.stdout and "good" in result.stdout
    assert time.process_time() - start < 3


def test_finished_runs_are_not_overwritten(repaired: tuple[Path, Result, dict[Path, int]]) -> None:
    folder, _, before = repaired
    result = call(*same(folder))
    assert_one_sentence(result.exit_code, result.stderr, folder / "out", "--resume")
    (folder / "few.yaml").write_text("features:\n  count: 700\nsegmentation:\n  source: none\n")
    result = call(*same(folder), "--resume")
    assert_one_sentence(result.exit_code, result.stderr, folder / "out" / "good" / "few", "other values")
    assert {path: path.stat().st_mtime_ns for path in before} == before


@pytest.mark.parametrize(
    "change",
    [{"failure": "it broke"}, {"processed": 4}, {"frames": 7, "processed": 7}, None],
    ids=["failed", "cut short", "another length", "half a file"],
)
def test_what_is_not_finished_is_run_again(
    change: dict[str, object] | None, repaired: tuple[Path, Result, dict[Path, int]], tmp_path: Path
) -> None:
    shutil.copytree(repaired[0] / "out" / "good" / "baseline" / "seed0", tmp_path / "seed0")
    sequence = repaired[0] / "data" / "good"
    (job,) = jobs(sequence, tmp_path, seeds=1)
    shutil.copytree(tmp_path / "seed0", job.folder, dirs_exist_ok=True)
    assert job.finished() is not None
    text = (job.folder / "metrics.json").read_text()
    text = text[:100] if change is None else json.dumps(json.loads(text) | change)
    (job.folder / "metrics.json").write_text(text)
    assert job.finished() is None


# --- Ctrl-C, crashes


def struck(arguments: Sequence[str | Path], when: Callable[[], bool]) -> subprocess.CompletedProcess[str]:
    """The command, with Ctrl-C as in a terminal, where all processes of a command get the signal."""
    with subprocess.Popen(  # noqa: S603
        command(*arguments),
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        deadline = time.monotonic() + 100
        while not when() and time.monotonic() < deadline:
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        stdout, stderr = process.communicate(timeout=100)
    return subprocess.CompletedProcess(process.args, process.returncode, stdout, stderr)


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to other processes")
def test_ctrl_c_keeps_what_was_computed_and_resume_goes_on(moment: Path, tmp_path: Path) -> None:
    sequence = repeated(moment, tmp_path / "long", frames=80)
    out = tmp_path / "out"
    arguments = ("--seqs", sequence, "--configs", "baseline", "--out", out)
    folder = out / "long" / "baseline" / "seed0"
    log = folder / "run.log"
    done = struck(arguments, lambda: log.is_file() and log.read_text().count(" frame ") >= 3)
    assert_one_sentence(done.returncode, done.stderr, "interrupted with 0 of 1 runs done", "--resume")
    assert "Traceback" not in done.stdout and "long, baseline, seed 0: failed: interrupted after" in done.stdout
    metrics = metrics_of(folder)
    assert 3 <= metrics["processed"] < 80
    assert len((folder / "trajectory.txt").read_text().splitlines()) == metrics["processed"]
    assert files_in(folder) | {"figures/masks.png", "groundtruth.txt"} == FILES | {"checkpoint.v3d"}
    assert pd.read_parquet(out / "runs.parquet")["failure"].tolist() == [metrics["failure"]]

    repeated(moment, sequence, frames=4)  # the rest is like the beginning
    result = call(*arguments, "--resume")
    assert result.exit_code == 0, result.output
    assert pd.read_parquet(out / "runs.parquet")["processed"].tolist() == [4]


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to other processes")
def test_ctrl_c_while_the_first_process_starts_and_no_other_is_started(moment: Path, tmp_path: Path) -> None:
    sequence = repeated(moment, tmp_path / "long", frames=80)
    arguments = ("--seqs", sequence, "--configs", "baseline", "--seeds", "2", "--out", tmp_path / "out")
    done = struck(arguments, (tmp_path / "out" / "summary.csv").exists)
    assert_one_sentence(done.returncode, done.stderr, "interrupted with 0 of 2 runs done")
    assert not (tmp_path / "out" / "long" / "baseline" / "seed1").exists()


@pytest.mark.skipif(os.name == "nt", reason="no SIGSEGV to other processes")
def test_a_process_that_dies_costs_one_run(moment: Path, tmp_path: Path) -> None:
    planned = jobs(repeated(moment, tmp_path / "long", frames=20), tmp_path / "out", seeds=2)
    ends: list[Finished] = []
    for event in Processes(2)(planned, Event()):
        if isinstance(event, Finished):
            ends.append(event)
        elif event.job is planned[0] and event.frames == 2:
            (process,) = (child for child in multiprocessing.active_children() if child.name == str(planned[0]))
            assert process.pid is not None
            os.kill(process.pid, signal.SIGSEGV)
    failures = {end.job.config.seed: end.failure for end in ends}
    assert failures[1] is None and "killed by SIGSEGV" in str(failures[0])
    log = (planned[0].folder / "run.log").read_text()
    assert " frame 1 at " in log and "Segmentation fault" in log
    assert planned[0].finished() is None
    finished = planned[1].finished()
    assert finished is not None and finished.metrics["tracked"] == 20


def test_ctrl_c_twice_kills_what_is_under_way(moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Struck(BatchProgress):
        def __call__(self, event: JobProgress | Finished) -> None:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(batch_module, "Bars", Struck)
    result = call("--seqs", moment, "--configs", "baseline", "--out", tmp_path)
    assert_one_sentence(result.exit_code, result.stderr, "interrupted twice", "--resume")
    assert not multiprocessing.active_children()


def test_tables_that_cannot_be_written_end_the_batch_after_the_runs_under_way(
    moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder takes the place of the table while runs are under way."""
    ended: list[str] = []

    def execute(planned: Sequence[Job], stop: Event) -> Generator[Finished]:
        (tmp_path / "runs.parquet").unlink()
        (tmp_path / "runs.parquet").mkdir()
        yield Finished(planned[0], "first")
        assert stop.is_set()
        ended.append("second")
        yield Finished(planned[1], "second")

    monkeypatch.setattr(batch_module, "Processes", lambda workers: execute)
    result = call("--seqs", moment, "--configs", "baseline", "--seeds", 2, "--out", tmp_path)
    assert_one_sentence(result.exit_code, result.stderr, tmp_path / "runs.parquet", "cannot be written")
    assert ended == ["second"]


def test_bars_show_each_run_that_is_under_way(moment: Path, tmp_path: Path) -> None:
    all_jobs = jobs(moment, tmp_path, seeds=4)
    first, second = all_jobs[1:3]
    screen = Console(force_terminal=True, width=100, file=StringIO())
    with progress_bars(screen) as progress:
        bars = BatchProgress(progress, all_jobs, all_jobs[1:])
        for event in (JobProgress(first, 0), JobProgress(second, 0), JobProgress(first, 5), Finished(second, None)):
            bars(event)
        shown = {task.description: (task.completed, task.total) for task in progress.tasks}
        notes = [task.fields["note"] for task in progress.tasks]
    assert shown == {"all runs": (6 + 5 + 6, 24), str(first): (5, 6)} and notes == ["2 of 4 runs", ""]


# --- bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--configs", "papper"), ("papper", "paper", "no_voting")),
        (("--configs", "nowhere/mine.yaml"), ("nowhere/mine.yaml",)),
        (("--seqs", "fr3/w/xzy"), ("fr3/w/xyz",)),
        (("--seqs", "nothing_*"), ("nothing_*", "matches no sequence")),
        (("--resume",), ("--resume", "--out")),
    ],
)
def test_bad_input_is_one_sentence_before_anything_runs(
    arguments: tuple[str, ...], words: tuple[str, ...], moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    out = () if "--resume" in arguments else ("--out", tmp_path / "out")
    result = call("--seqs", moment, *arguments, *out)
    assert_one_sentence(result.exit_code, result.stderr, *words)
    assert not list(tmp_path.iterdir())


def test_a_sequence_that_cannot_be_opened_is_told_before_anything_runs(moment: Path, tmp_path: Path) -> None:
    shutil.copytree(moment, tmp_path / "half")
    (tmp_path / "half" / "associations.txt").unlink()
    (tmp_path / "half" / "depth.txt").unlink()
    result = call("--seqs", moment, tmp_path / "half", "--configs", "baseline", "--out", tmp_path / "out")
    assert_one_sentence(result.exit_code, result.stderr, tmp_path / "half", "depth.txt")
    assert not (tmp_path / "out").exists()


def test_configurations_that_cannot_be_told_apart(moment: Path, tmp_path: Path) -> None:
    (tmp_path / "paper.yaml").write_text("seed: 0\n")
    result = call("--seqs", moment, "--configs", "paper", tmp_path / "paper.yaml", "--out", tmp_path / "out")
    assert_one_sentence(result.exit_code, result.stderr, tmp_path / "paper.yaml", "called paper too")


def test_full_and_default_are_one_and_the_seed_is_the_batchs(tmp_path: Path) -> None:
    mine = str(tmp_path / "mine.yaml")
    Path(mine).write_text("seed: 7\nthreads: 2\nsegmentation: {threads: 2}\n")
    configs = read_configs(["default", "full", mine], one_thread=False)
    assert list(configs) == ["full", "mine"] and configs["full"] == load_config()
    one, two = read_configs([mine], one_thread=True)["mine"], configs["mine"]
    assert [(config.threads, config.segmentation.threads) for config in (one, two)] == [(1, 1), (2, 2)]


@pytest.mark.parametrize("below", [False, True])
def test_a_file_where_the_results_belong(below: bool, moment: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    out = tmp_path / "taken" / "out" if below else tmp_path / "taken"
    result = call("--seqs", moment, "--configs", "baseline", "--out", out)
    assert_one_sentence(result.exit_code, result.stderr, tmp_path / "taken")


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="nothing is read-only to this user")
def test_a_folder_that_cannot_be_written(moment: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir(mode=0o555)
    result = call("--seqs", moment, "--configs", "baseline", "--out", tmp_path / "out")
    assert_one_sentence(result.exit_code, result.stderr, tmp_path / "out", "cannot be written")


@pytest.mark.parametrize("option", ["--seeds", "--workers"])
def test_none_are_refused_by_the_command_line(option: str, moment: Path, tmp_path: Path) -> None:
    assert call("--seqs", moment, option, "0", "--out", tmp_path / "out").exit_code == 2
    assert not (tmp_path / "out").exists()


def test_help_is_light() -> None:
    assert "--ray" in call("--help").stdout
    probe = "import sys, v3d_torch.cli.batch; print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)  # noqa: S603
    assert result.stdout.strip() == "False"
