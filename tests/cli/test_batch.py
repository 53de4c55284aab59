"""Command ``v3d-torch batch``: results, tables, --resume, Ctrl-C, bad input."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path
from threading import Event

import numpy as np
import pandas as pd
import psutil
import pytest
import yaml
from helpers.batches import ENDLESS, plan_seeds, repeat_sequence, without_camera_and_stamps
from helpers.commands import RUN_FILES, assert_error_line, files_in, invoke
from helpers.privileges import without_root_rights
from helpers.waiting import wait_until
from typer.testing import Result

from v3d_torch.batch import runner
from v3d_torch.batch.batch_record import METRIC_TYPES
from v3d_torch.batch.executor import JobFinished, JobProgress
from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.batch.progress import BatchProgress
from v3d_torch.cli.batch import app
from v3d_torch.config.loading import load_config
from v3d_torch.runs.result_folder import lock_results
from v3d_torch.runtime.hangup import handled_hangup

BROKEN_AT = 3
"""Index of the damaged image."""


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "v3d_torch", "batch", *map(str, arguments)]


def environment() -> dict[str, str]:
    own = {key: value for key, value in os.environ.items() if key != "V3D_DATA"}
    return own | {"OMP_NUM_THREADS": "1", "NO_COLOR": "1"}


call = partial(invoke, app, V3D_DATA="", NO_COLOR="1")
"""Call the command in this process; its runs have processes of their own."""


def metrics_of(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def break_frame(sequence: Path, index: int) -> Path:
    """Truncate a colour image and return its path."""
    colour = sorted((sequence / "rgb").iterdir())[index]
    colour.write_bytes(colour.read_bytes()[:1000])
    return colour


@pytest.fixture(scope="module")
def work(moment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a configuration and two sequences, one of them with a damaged image."""
    folder = tmp_path_factory.mktemp("work")
    for name in ("broken", "good"):
        shutil.copytree(moment, folder / "data" / name)
    break_frame(folder / "data" / "broken", BROKEN_AT)
    (folder / "data" / "notes").mkdir()
    (folder / "few.yaml").write_text("segmentation:\n  source: none\nfeatures:\n  count: 800\n")
    return folder


@pytest.fixture(scope="module")
def done(work: Path) -> Result:
    """Batch of two sequences, matched by a pattern, and two configurations with two workers; results in ``out``."""
    arguments = ("--seqs", "*", "--data-root", work / "data", "--configs", "baseline", work / "few.yaml")
    return call(*arguments, "--workers", "2", "--out", work / "out")


RUNS = [(sequence, config) for sequence in ("broken", "good") for config in ("baseline", "few")]


# --- a batch


def test_successful_runs_write_all_result_files(done: Result, work: Path) -> None:
    for config, file in (("baseline", None), ("few", work / "few.yaml")):
        folder = work / "out" / "good" / config / "seed0"
        assert files_in(folder) == RUN_FILES
        overrides = ["segmentation.source=none"] if file is None else []
        assert load_config(folder / "config.yaml") == single_threaded(load_config(file, overrides))
    assert {path.name for path in (work / "out").iterdir()} == {
        *("broken", "good", "runs.parquet", "summary.md", "summary.tex", "summary.csv"),
    }


def test_failed_run_is_reported_and_others_finish(done: Result, work: Path) -> None:
    assert_error_line(done, "2 of 4 runs failed", "--resume")
    image = sorted((work / "data" / "broken" / "rgb").iterdir())[BROKEN_AT]
    lines = done.stdout.splitlines()
    failures = [f"broken, {config}, seed 0: failed: {image}" for config in ("baseline", "few")]
    assert lines[-4] == "failed:"
    for failure, line in zip(failures, lines[-3:-1], strict=True):
        assert line.startswith(failure)
    assert lines[-1] == f"results: {work / 'out'}"
    for config in ("baseline", "few"):
        folder = work / "out" / "broken" / config / "seed0"
        assert files_in(folder) == RUN_FILES | {"checkpoint.v3d"}
        assert len((folder / "trajectory.txt").read_text().splitlines()) == BROKEN_AT
        assert str(image) in (folder / "run.log").read_text()
        assert str(image) in metrics_of(folder)["failure"]


def test_folders_that_are_no_sequence_are_noted(done: Result) -> None:
    assert "note: *: 1 folder is no sequence and is left out: notes" in done.stdout.splitlines()


def test_output_without_terminal_has_no_progress_bars(done: Result) -> None:
    assert "\x1b" not in done.stdout and "all runs" not in done.stdout
    assert sum(line.startswith(("good, ", "broken, ")) for line in done.stdout.splitlines()) == 4 + 2


def test_runs_table_matches_metrics_of_each_run(done: Result, work: Path) -> None:
    table = pd.read_parquet(work / "out" / "runs.parquet")
    assert list(zip(table["sequence"], table["config"], strict=True)) == RUNS
    assert (table["seed"] == 0).all()
    for _, row in table.iterrows():
        folder = work / "out" / row["path"]
        assert folder == work / "out" / row["sequence"] / row["config"] / "seed0"
        metrics = metrics_of(folder)
        assert (None if pd.isna(row["failure"]) else row["failure"]) == metrics["failure"]
        for name in METRIC_TYPES:
            value: object = metrics
            for key in name.split("."):
                value = value.get(key) if isinstance(value, dict) else None
            cell = row[name.replace(".", "_")]
            if row["sequence"] == "broken" or value is None:
                assert np.isnan(cell), name  # a failed run has no metrics
            else:
                assert cell == value, name
    good = table[table["sequence"] == "good"]
    assert (good["tracked"] == 6).all() and (good["coverage"] == 1).all() and (good["peak_memory_mb"] > 50).all()
    assert (good["masks_moving_masked"] == 0).all()  # true masks, but no segmentation


def test_summaries_match_metrics_of_runs(done: Result, work: Path) -> None:
    ates = {c: metrics_of(work / "out" / "good" / c / "seed0")["ate"]["rmse"] for c in ("baseline", "few")}
    shown = {c: f"**{ate:.4f}**" if ate == min(ates.values()) else f"{ate:.4f}" for c, ate in ates.items()}
    document = (work / "out" / "summary.md").read_text()
    assert f"| good | {shown['baseline']} | {shown['few']} |" in document
    assert "| broken | failed | failed |" in document
    assert "good & " in (work / "out" / "summary.tex").read_text()
    rows = list(csv.DictReader((work / "out" / "summary.csv").open(newline="")))
    medians = {row["method"]: row["median"] for row in rows if (row["metric"], row["sequence"]) == ("ate.rmse", "good")}
    assert {config: float(value) for config, value in medians.items()} == ates


def test_warnings_of_a_run_are_on_the_console_and_in_the_tables(moment: Path, tmp_path: Path) -> None:
    sequence, out = shutil.copytree(moment, tmp_path / "small"), tmp_path / "out"
    camera = yaml.safe_load((sequence / "camera.yaml").read_text())
    (sequence / "camera.yaml").write_text(yaml.safe_dump(camera | {"depth_scale": camera["depth_scale"] * 20}))
    result = call("--seqs", sequence, moment, "--configs", "baseline", "--out", out)
    assert result.exit_code == 0, result.output
    (warning,) = metrics_of(out / "small" / "baseline" / "seed0")["warnings"]
    assert "depth_scale" in warning
    lines = result.stdout.splitlines()
    assert [line for line in lines if line.startswith("warning: ")] == [f"warning: {warning}"]
    assert lines[lines.index(f"warning: {warning}") - 1].startswith("small, baseline, seed 0: ")
    document = (out / "summary.md").read_text()
    assert document.endswith(f"## Warnings\n\n- small, baseline, seed 0: {warning}\n")
    assert pd.read_parquet(out / "runs.parquet")["warnings"].tolist() == [warning, ""]


def test_ground_truth_of_another_recording_is_told_in_batch_and_table(moment: Path, tmp_path: Path) -> None:
    foreign, out = shutil.copytree(moment, tmp_path / "foreign"), tmp_path / "out"
    lines = (foreign / "groundtruth.txt").read_text().splitlines()
    poses = [line.split() for line in lines if not line.startswith("#")]
    late = [" ".join([f"{float(stamp) + 1e6:.6f}", *pose]) for stamp, *pose in poses]
    (foreign / "groundtruth.txt").write_text("\n".join(late) + "\n")
    result = call("--seqs", moment, "--seqs", foreign, "--configs", "baseline", "--out", out)
    assert_error_line(result, "1 of 2 runs have incomplete results; the causes are above")
    diagnosis = metrics_of(out / "foreign" / "baseline" / "seed0")["diagnosis"]
    shown = result.stdout.splitlines()
    assert shown[shown.index("incomplete:") + 1] == f"foreign, baseline, seed 0: {diagnosis}"
    assert pd.read_parquet(out / "runs.parquet")["diagnosis"].fillna("").tolist() == ["", diagnosis]


# --- resume


@pytest.fixture(scope="module")
def repaired(done: Result, work: Path) -> tuple[Path, Result, dict[Path, int]]:
    """Copy of the batch, resumed with one worker after the damaged image was restored.

    Returns:
        Folder of the copy, result of the command, and modification times of the finished results before it.
    """
    shutil.copytree(work, work.parent / "again", copy_function=shutil.copy2)
    again = work.parent / "again"
    for image in (again / "data" / "good" / "rgb").iterdir():
        shutil.copy2(image, again / "data" / "broken" / "rgb")
    before = {path: path.stat().st_mtime_ns for path in (again / "out" / "good").rglob("*") if path.is_file()}
    result = call(*arguments_in(again), "--resume")
    return again, result, before


def arguments_in(folder: Path) -> list[str | Path]:
    """Command line of the batch in a folder, without --workers."""
    configs = ("--configs", folder / "few.yaml", "--configs", "baseline")
    return ["--seqs", "good", "--seqs", "broken", *configs, "--data-root", folder / "data", "--out", folder / "out"]


def test_resume_runs_only_failed_runs(repaired: tuple[Path, Result, dict[Path, int]]) -> None:
    folder, result, before = repaired
    assert result.exit_code == 0, result.output
    assert {path: path.stat().st_mtime_ns for path in before} == before
    ended = [line.split(", seed")[0] for line in result.stdout.splitlines() if ", seed" in line]
    assert ended == ["broken, few", "broken, baseline"]
    table = pd.read_parquet(folder / "out" / "runs.parquet")
    order = [(sequence, config) for sequence in ("good", "broken") for config in ("few", "baseline")]
    assert list(zip(table["sequence"], table["config"], strict=True)) == order
    assert table["failure"].isna().all() and (table["tracked"] == 6).all()
    assert "ailed" not in (folder / "out" / "summary.md").read_text()


def test_results_are_identical_with_one_and_two_workers(repaired: tuple[Path, Result, dict[Path, int]]) -> None:
    """The restored sequence has the images of the good one, whose runs had two workers."""
    out = repaired[0] / "out"
    for config in ("baseline", "few"):
        for name in ("trajectory.txt", "keyframes.txt", "objects.parquet", "map.ply"):
            one, two = (out / sequence / config / "seed0" / name for sequence in ("broken", "good"))
            assert one.read_bytes() == two.read_bytes(), (config, name)


def test_resume_of_complete_batch_only_prints_tables(
    repaired: tuple[Path, Result, dict[Path, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def execute(planned: Sequence[Job], stop: Event) -> Generator[JobFinished]:
        assert not planned
        yield from ()

    folder, _, _ = repaired
    monkeypatch.setattr(runner, "ProcessExecutor", lambda workers: execute)
    result = call(*arguments_in(folder), "--resume", "--workers", "2")  # threads do not count as a difference
    assert result.exit_code == 0 and ", seed" not in result.stdout and "good" in result.stdout


def test_finished_runs_are_not_overwritten(repaired: tuple[Path, Result, dict[Path, int]]) -> None:
    folder, _, before = repaired
    result = call(*arguments_in(folder))
    assert_error_line(result, folder / "out", "--resume")
    (folder / "few.yaml").write_text("features:\n  count: 700\nsegmentation:\n  source: none\n")
    result = call(*arguments_in(folder), "--resume")
    assert_error_line(result, folder / "out" / "good" / "few", "other values")
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_camera_and_frame_rate_of_sequences_without_them(moment: Path, tmp_path: Path) -> None:
    sequence, camera = without_camera_and_stamps(moment, tmp_path)
    arguments = ("--seqs", sequence, "--configs", "baseline", "--fps", "25", "--out", tmp_path / "out")
    assert_error_line(call(*arguments), "--camera")
    result = call(*arguments, "--camera", camera)
    assert result.exit_code == 0 and "no ground truth" in result.output, result.output
    folder = tmp_path / "out" / "numbered" / "baseline" / "seed0"
    stamps = [float(line.split()[0]) for line in (folder / "trajectory.txt").read_text().splitlines()]
    assert stamps == pytest.approx([index / 25 for index in range(len(stamps))], abs=1e-6)
    request = yaml.safe_load((folder / "request.yaml").read_text())
    assert (request["camera"], request["fps"]) == (str(camera), 25)
    assert ", seed" not in call(*arguments, "--camera", camera, "--resume").stdout
    (tmp_path / "other.yaml").write_text(camera.read_text().replace("fx: ", "fx: 1"))
    changed = call(*arguments, "--camera", tmp_path / "other.yaml", "--resume")
    assert_error_line(changed, "contains a finished run with another camera")


@pytest.fixture
def moved(repaired: tuple[Path, Result, dict[Path, int]], tmp_path: Path) -> tuple[Path, list[str | Path]]:
    """Copy of a sequence and of its finished run, and the arguments that resume the batch."""
    data, out = tmp_path / "moved" / "good", tmp_path / "out"
    shutil.copytree(repaired[0] / "data" / "good", data)
    shutil.copytree(repaired[0] / "out" / "good", out / "good")
    return data, ["--seqs", data, "--configs", "baseline", "--out", out, "--resume"]


def test_finished_run_of_a_moved_sequence_is_kept(moved: tuple[Path, list[str | Path]]) -> None:
    result = call(*moved[1])
    assert result.exit_code == 0 and ", seed" not in result.stdout, result.output


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("camera.yaml", "depth_scale: ", "depth_scale: 1"),
        ("groundtruth.txt", " -0.137705860 ", " -0.237705860 "),
        ("associations.txt", "2.733333 rgb/", "2.730000 rgb/"),
    ],
)
def test_finished_run_of_another_recording_or_camera_is_not_kept(
    name: str, before: str, after: str, moved: tuple[Path, list[str | Path]]
) -> None:
    data, arguments = moved
    text = (data / name).read_text()
    assert before in text
    (data / name).write_text(text.replace(before, after, 1))
    folder = data.parents[1] / "out" / "good" / "baseline" / "seed0"
    written = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert_error_line(call(*arguments), f"{folder}: contains a finished run with another camera", data)
    assert {path: path.read_bytes() for path in folder.iterdir() if path.is_file()} == written

    metrics = metrics_of(folder)
    del metrics["sequence_digest"]  # as an earlier version wrote it
    (folder / "metrics.json").write_text(json.dumps(metrics))
    assert call(*arguments).exit_code == 0


def test_tables_keep_the_runs_of_an_earlier_batch(
    repaired: tuple[Path, Result, dict[Path, int]], tmp_path: Path
) -> None:
    folder, _, _ = repaired
    out, data = folder / "out", folder / "data"
    before = {path: path.read_bytes() for path in out.glob("*.*")}
    other = repeat_sequence(data / "good", tmp_path / "other", frames=4)
    for arguments in (("--seqs", data / "good", "--resume"), ("--seqs", other)):
        result = call(*arguments, "--configs", "baseline", "--out", out)
        assert_error_line(result, f"{out}: the tables have runs of other sequences", "such as good/few/seed0; give")
    assert {path: path.read_bytes() for path in out.glob("*.*")} == before and not (out / "other").exists()


def test_folder_to_which_another_batch_writes_is_error(moment: Path, tmp_path: Path) -> None:
    arguments = ("--seqs", moment, "--configs", "baseline", "--out", tmp_path / "out")
    with lock_results(tmp_path / "out"):
        for resume in ((), ("--resume",)):
            result = call(*arguments, *resume)
            assert_error_line(result, f"{tmp_path / 'out'}: another run or batch is writing to this folder")
        assert files_in(tmp_path / "out") == {".run.lock"}


@pytest.mark.parametrize(
    "change",
    [{"failure": "it broke"}, {"processed": 4}, {"frames": 7, "processed": 7}, None],
    ids=["failed", "cut short", "another length", "half a file"],
)
def test_incomplete_run_has_no_earlier_outcome(
    change: dict[str, object] | None, repaired: tuple[Path, Result, dict[Path, int]], tmp_path: Path
) -> None:
    shutil.copytree(repaired[0] / "out" / "good" / "baseline" / "seed0", tmp_path / "seed0")
    sequence = repaired[0] / "data" / "good"
    (job,) = plan_seeds(sequence, tmp_path, seeds=1)
    shutil.copytree(tmp_path / "seed0", job.folder, dirs_exist_ok=True)
    assert job.earlier_outcome() is not None
    text = (job.folder / "metrics.json").read_text()
    text = text[:100] if change is None else json.dumps(json.loads(text) | change)
    (job.folder / "metrics.json").write_text(text)
    assert job.earlier_outcome() is None


# --- Ctrl-C


def interrupt(
    arguments: Sequence[str | Path], when: Callable[[psutil.Process], bool], number: signal.Signals = signal.SIGINT
) -> subprocess.CompletedProcess[str]:
    """Run the command and send a signal to all its processes, as a terminal does, when a condition holds.

    The test fails if the command ends before, or if the condition does not hold within 100 seconds.
    """
    with subprocess.Popen(  # noqa: S603
        command(*arguments),
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:

        def is_due() -> bool:
            assert process.poll() is None, "the command ended before the interrupt"
            return when(psutil.Process(process.pid))

        try:
            wait_until(is_due, timeout=100, what="the condition of the interrupt")
            os.killpg(process.pid, number)
            stdout, stderr = process.communicate()
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    return subprocess.CompletedProcess(process.args, process.returncode, stdout, stderr)


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to other processes")
@pytest.mark.parametrize("number", [signal.SIGINT, *handled_hangup()])
def test_signal_of_a_terminal_keeps_partial_results_and_resume_finishes(
    number: signal.Signals, moment: Path, tmp_path: Path
) -> None:
    sequence = repeat_sequence(moment, tmp_path / "long", ENDLESS)
    out = tmp_path / "out"
    arguments = ("--seqs", sequence, "--configs", "baseline", "--out", out)
    folder = out / "long" / "baseline" / "seed0"
    log = folder / "run.log"
    done = interrupt(arguments, lambda _: log.is_file() and log.read_text().count(" frame ") >= 3, number)
    assert_error_line(done, "interrupted with 0 of 1 runs done", "--resume")
    assert "Traceback" not in done.stdout and "long, baseline, seed 0: failed: interrupted after" in done.stdout
    metrics = metrics_of(folder)
    assert 3 <= metrics["processed"] < ENDLESS
    assert len((folder / "trajectory.txt").read_text().splitlines()) == metrics["processed"]
    assert files_in(folder) | {"figures/masks.png", "groundtruth.txt"} == RUN_FILES | {"checkpoint.v3d"}
    assert pd.read_parquet(out / "runs.parquet")["failure"].tolist() == [metrics["failure"]]

    repeat_sequence(moment, sequence, frames=4)  # the shortened sequence has the same frames
    result = call(*arguments, "--resume")
    assert result.exit_code == 0, result.output
    assert pd.read_parquet(out / "runs.parquet")["processed"].tolist() == [4]


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to other processes")
def test_ctrl_c_during_first_start_starts_no_other_process(moment: Path, tmp_path: Path) -> None:
    sequence = repeat_sequence(moment, tmp_path / "long", ENDLESS)
    out = tmp_path / "out"
    arguments = ("--seqs", sequence, "--configs", "baseline", "--seeds", "2", "--out", out)
    # The batch writes its tables, then starts the process of its first job.
    done = interrupt(arguments, lambda batch: (out / "summary.csv").exists() and bool(batch.children()))
    assert_error_line(done, "interrupted with 0 of 2 runs done")
    assert not (out / "long" / "baseline" / "seed1").exists()


def test_second_ctrl_c_kills_running_jobs(moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class InterruptTwice(BatchProgress):
        def __call__(self, event: JobProgress | JobFinished) -> None:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(runner, "BatchProgress", InterruptTwice)
    result = call("--seqs", moment, "--configs", "baseline", "--out", tmp_path)
    assert_error_line(result, "interrupted twice", "--resume")
    assert not multiprocessing.active_children()


def test_unwritable_tables_end_batch_after_running_jobs(
    moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder replaces the table while jobs are running."""
    ended: list[str] = []

    def execute(planned: Sequence[Job], stop: Event) -> Generator[JobFinished]:
        (tmp_path / "runs.parquet").unlink()
        (tmp_path / "runs.parquet").mkdir()
        yield JobFinished(planned[0], "first")
        assert stop.is_set()
        ended.append("second")
        yield JobFinished(planned[1], "second")

    monkeypatch.setattr(runner, "ProcessExecutor", lambda workers: execute)
    result = call("--seqs", moment, "--configs", "baseline", "--seeds", 2, "--out", tmp_path)
    assert_error_line(result, tmp_path / "runs.parquet", "cannot be written")
    assert ended == ["second"]


# --- bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--configs", "papper"), ("papper", "paper", "no_voting")),
        (("--configs", "nowhere/mine.yaml"), ("nowhere/mine.yaml",)),
        (("--seqs", "fr3/w/xzy"), ("fr3/w/xyz",)),
        (("--seqs", "nothing_*"), ("nothing_*", "matches no sequence")),
        (("--resume",), ("--resume", "--out")),
        (("--resume", "--out", "studdy"), ("studdy: is not a folder; pass the folder of the batch with --out",)),
        (("--resume", "--out", "."), (".: has no runs of a batch; pass the folder of the batch with --out",)),
        (("--out", ""), ("--out: is an empty path; give a path",)),
        (("--data-root=",), ("--data-root: is an empty path; give a path",)),
    ],
)
def test_bad_input_is_one_line_before_first_run(
    arguments: tuple[str, ...], words: tuple[str, ...], moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    out = () if {"--resume", "--out"} & set(arguments) else ("--out", tmp_path / "out")
    result = call("--seqs", moment, *arguments, *out)
    assert_error_line(result, *words)
    assert not list(tmp_path.iterdir())


def test_unreadable_sequence_is_error_before_first_run(moment: Path, tmp_path: Path) -> None:
    shutil.copytree(moment, tmp_path / "half")
    (tmp_path / "half" / "associations.txt").unlink()
    (tmp_path / "half" / "depth.txt").unlink()
    result = call("--seqs", moment, tmp_path / "half", "--configs", "baseline", "--out", tmp_path / "out")
    assert_error_line(result, tmp_path / "half", "depth.txt")
    assert not (tmp_path / "out").exists()


def test_option_without_a_value_is_an_error() -> None:
    """As that of an empty variable of the shell: the next option was taken for its value."""
    result = call("--seqs", "--configs", "baseline")
    assert_error_line(result, "--seqs: has no value before --configs; give at least one")


def test_configurations_with_same_name_are_rejected(moment: Path, tmp_path: Path) -> None:
    (tmp_path / "paper.yaml").write_text("seed: 0\n")
    result = call("--seqs", moment, "--configs", "paper", tmp_path / "paper.yaml", "--out", tmp_path / "out")
    assert_error_line(result, tmp_path / "paper.yaml", "also named paper")


@pytest.mark.parametrize("resume", [False, True])
def test_folder_of_an_ablation_study_is_error(resume: bool, moment: Path, tmp_path: Path) -> None:
    """Its runs have the same folders as those of a batch, but times that are not those of single runs."""
    (tmp_path / "moment" / "baseline" / "seed0").mkdir(parents=True)
    (tmp_path / "moment" / "baseline" / "seed0" / "run.log").touch()
    (tmp_path / "ablation.csv").touch()
    result = call("--seqs", moment, "--configs", "baseline", "--out", tmp_path, *["--resume"] * resume)
    assert_error_line(result, f"{tmp_path}: contains an ablation study; choose another folder with --out")
    assert not (tmp_path / "runs.parquet").exists()


@pytest.mark.parametrize("below", [False, True])
def test_file_in_place_of_result_folder_is_error(below: bool, moment: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    out = tmp_path / "taken" / "out" if below else tmp_path / "taken"
    result = call("--seqs", moment, "--configs", "baseline", "--out", out)
    assert_error_line(result, tmp_path / "taken")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no read-only folders")
def test_unwritable_result_folder_is_error(moment: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir(mode=0o555)
    with without_root_rights():
        result = call("--seqs", moment, "--configs", "baseline", "--out", tmp_path / "out")
    assert_error_line(result, tmp_path / "out", "cannot be written")


@pytest.mark.parametrize("option", ["--seeds", "--workers"])
def test_zero_seeds_or_workers_are_rejected(option: str, moment: Path, tmp_path: Path) -> None:
    assert call("--seqs", moment, option, "0", "--out", tmp_path / "out").exit_code == 2
    assert not (tmp_path / "out").exists()


def test_help_names_the_options() -> None:
    assert "--ray" in call("--help").stdout


def test_number_of_seeds_has_a_limit(moment: Path, tmp_path: Path) -> None:
    result = call("--seqs", moment, "--seeds", "99999999999", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "--seeds" in result.stderr and not (tmp_path / "out").exists()
