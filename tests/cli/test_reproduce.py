"""Command ``v3d-torch reproduce``: downloads, missing sequences, tables, the study, --resume, bad input."""

from __future__ import annotations

import csv
import json
import shutil
import tarfile
from collections.abc import Generator, Iterator, Sequence
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import pandas as pd
import pytest
from helpers.commands import assert_error_line, invoke
from helpers.http_server import QuietHandler, running_server

from v3d_torch.batch import reproduction
from v3d_torch.batch.executor import JobFinished
from v3d_torch.batch.job import Job
from v3d_torch.cli.reproduce import app
from v3d_torch.config.loading import CONFIGS, load_config
from v3d_torch.datasets import PAPER_SEQUENCES, locate, short_name
from v3d_torch.datasets.tum_extents import EXTENTS
from v3d_torch.evaluation.ablation import VARIANTS
from v3d_torch.evaluation.paper_tables import load_paper_scores
from v3d_torch.runs.result_folder import lock_results

SHORT = [short_name(name) for name in PAPER_SEQUENCES]
SERVED = [name for name in PAPER_SEQUENCES if name.endswith(("walking_xyz", "sitting_rpy"))]
"""Sequences on the server."""


call = partial(invoke, app, V3D_DATA="", NO_COLOR="1")


def table_in(document: str, heading: str) -> dict[str, dict[str, str]]:
    """Table in a section of a Markdown document: rows by their first cell, cells by the heading of their column."""
    section = document.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    lines = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    return {line[0]: dict(zip(lines[0], line, strict=True)) for line in lines[2:]}


def mark(full_name: str) -> str:
    """Name in the tables; the sequences on the server have the names, but not the frames, of the benchmark."""
    name = short_name(full_name)
    frames = EXTENTS[name].frames.number
    return f"{name} (another recording: 6 frames, not {frames})" if full_name in SERVED else name


def plain(cell: str) -> str:
    return cell.strip("*")


@pytest.fixture(scope="module")
def archives(moment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Archives in the layout of the benchmark; six frames 0.25 s apart, so that there is RPE over 1 s."""
    folder = tmp_path_factory.mktemp("server")
    pairs = [line.split() for line in (moment / "associations.txt").read_text().splitlines()]
    truth = [line.split() for line in (moment / "groundtruth.txt").read_text().splitlines() if line[0] != "#"]
    poses = {float(pose[0]): pose[1:] for pose in truth}
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for k, (stamp, colour, _, depth) in enumerate(pairs):
        lists["rgb"].append(f"{k / 4:.6f} {colour}")
        lists["depth"].append(f"{k / 4:.6f} {depth}")
        nearest = min(poses, key=lambda other: abs(other - float(stamp)))
        lists["groundtruth"].append(" ".join([f"{k / 4:.6f}", *poses[nearest]]))
    for name in SERVED:
        for kind, lines in lists.items():
            (folder / f"{kind}.txt").write_text("# comment line\n" + "\n".join(lines) + "\n")
        with tarfile.open(folder / f"{name}.tgz", "w:gz", compresslevel=1) as archive:
            for kind in lists:
                archive.add(folder / f"{kind}.txt", f"{name}/{kind}.txt")
            for images in ("rgb", "depth"):
                archive.add(moment / images, f"{name}/{images}")
            archive.add(moment / "camera.yaml", f"{name}/camera.yaml")
    return folder


@pytest.fixture
def server(archives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.setenv("V3D_CACHE", str(tmp_path / "cache"))
    with running_server(partial(QuietHandler, directory=str(archives))) as address:
        monkeypatch.setattr(locate, "download_url", lambda name: f"{address}/{name}.tgz")
        yield address


@pytest.fixture
def fake_runs(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Descriptions of the jobs that were run. Jobs only write metrics: an ATE of 1 cm for the first variant, 2 cm for
    the next, and so on.
    """
    executed: list[str] = []

    def execute(jobs: Sequence[Job], stop: Event) -> Generator[JobFinished]:
        for job in jobs:
            executed.append(str(job))
            job.folder.mkdir(parents=True, exist_ok=True)
            metrics = metrics_of(0.01 * (1 + VARIANTS.index(job.config_name)), job.frames)
            (job.folder / "metrics.json").write_text(json.dumps(metrics))
            (job.folder / "config.yaml").write_text(job.config.model_dump_json())
            yield JobFinished(job, None)

    monkeypatch.setattr(reproduction, "ProcessExecutor", lambda workers: execute)
    monkeypatch.setattr(reproduction, "prepare_stages", lambda configs: None)
    return executed


def metrics_of(ate: float, frames: int = 6) -> dict[str, Any]:
    errors = {"ate": {"rmse": ate}, "rpe": {"trans": {"rmse": ate / 2}, "rot": {"rmse": 10 * ate}}}
    return errors | {"frames": frames, "processed": frames, "failure": None}


# --- with real runs


def test_missing_sequences_are_downloaded_run_and_tabulated(server: str, tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    result = call("--data-root", data, "--configs", "baseline", "--out", out)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in data.iterdir() if path.is_dir()) == sorted(SERVED)
    (note,) = [line for line in result.stdout.splitlines() if line.startswith("missing sequences: ")]
    assert all((name in note) == (name not in SERVED) for name in PAPER_SEQUENCES)
    assert "404" in note and str(data) in note

    document = (out / "summary.md").read_text()
    for metric, heading, places in (
        ("ate", "ATE, m", ("ate",)),
        ("rpe_trans", "RPE, m/s", ("rpe", "trans")),
        ("rpe_rot", "RPE, deg/s", ("rpe", "rot")),
    ):
        table = table_in(document, heading)
        assert list(table) == [mark(name) for name in PAPER_SEQUENCES]
        for full_name, (label, cells) in zip(PAPER_SEQUENCES, table.items(), strict=True):
            sequence = label.partition(" (")[0]
            score = load_paper_scores()[metric][sequence]["V3D-SLAM"].rmse
            assert plain(cells["V3D-SLAM (paper)"]) == f"{score:.4f}"
            if full_name not in SERVED:
                assert cells["baseline"] == "not here"
                continue
            metrics = json.loads((out / sequence.replace("/", "_") / "baseline" / "seed0/metrics.json").read_text())
            for place in places:
                metrics = metrics[place]
            assert plain(cells["baseline"]) == f"{metrics['rmse']:.4f}"
    assert "not here" in result.stdout and "ORB-SLAM2" in result.stdout
    runs = pd.read_parquet(out / "runs.parquet").set_index("sequence")["difference"]
    for name in SERVED:
        difference = mark(name).partition(" (")[2].removesuffix(")")
        assert result.stdout.count(f"({difference})") == 4  # the line of the run, and three tables
        assert difference in (out / "summary.tex").read_text() and difference in (out / "summary.csv").read_text()
        assert runs[short_name(name)] == difference
    assert not (out / "ablation.md").exists()

    before = {path: path.stat().st_mtime_ns for path in out.rglob("metrics.json")}
    assert len(before) == 2
    again = call("--data-root", data, "--no-download", "--configs", "baseline", "--out", out, "--resume")
    assert again.exit_code == 0 and ", seed" not in again.stdout
    assert {path: path.stat().st_mtime_ns for path in before} == before


# --- with fake runs


def test_study_has_all_variants_and_tables_have_chosen_configs(
    server: str, fake_runs: list[str], tmp_path: Path
) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    result = call("--data-root", data, "--ablation", "--seeds", "2", "--out", out)
    assert result.exit_code == 0, result.output
    assert len(fake_runs) == 2 * len(VARIANTS) * 2
    ours = [
        method for method in table_in((out / "summary.md").read_text(), "ATE, m")[SHORT[0]] if "paper)" not in method
    ]
    assert ours == ["sequence", "full", "paper", "baseline"]

    study = table_in((out / "ablation.md").read_text(), "Ablation: ATE, m")
    assert list(study) == [*SHORT, "ratio to full", "ratio to full (paper)"]
    assert [method for method in study["fr3/w/xyz"] if method != "sequence"] == list(VARIANTS)
    assert study["fr3/w/xyz"]["no_voting"] == "0.0200" and study["fr3/s/xyz"]["no_voting"] == "not here"
    full = 1 + VARIANTS.index("full")
    assert study["ratio to full"]["no_voting"] == f"{2 / full:.2f}" and study["ratio to full"]["full"] == "1.00"
    assert (study["ratio to full (paper)"]["no_voting"], study["ratio to full (paper)"]["not_upright"]) == ("4.00", "-")
    for name in ("summary.tex", "ablation.tex"):
        text = (out / name).read_text()
        assert text.startswith("% \\usepackage{booktabs}") and "not here" in text
    assert (
        "geometric mean" in (out / "ablation.md").read_text() and "geometric mean" in (out / "ablation.tex").read_text()
    )
    rows = list(csv.DictReader((out / "ablation.csv").open(newline="")))
    assert len(rows) == len(fake_runs) and {row["variant"] for row in rows} == set(VARIANTS)
    assert "ratio to full" in result.stdout
    assert len(pd.read_parquet(out / "runs.parquet")) == len(fake_runs)


def test_resume_runs_sequences_added_since(server: str, fake_runs: list[str], tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    arguments = ("--data-root", data, "--out", out)
    assert call(*arguments).exit_code == 0
    first = list(fake_runs)
    shutil.copytree(data / SERVED[0], data / "rgbd_dataset_freiburg3_walking_static")
    refused = call(*arguments, "--no-download")
    assert_error_line(refused, out, "--resume")
    result = call(*arguments, "--no-download", "--resume")
    assert result.exit_code == 0, result.output
    assert fake_runs == [*first, *(f"fr3/w/static, {config}, seed 0" for config in reproduction.TABLE_CONFIGS)]


def test_runs_use_configurations_of_the_package(server: str, fake_runs: list[str], tmp_path: Path) -> None:
    assert call("--data-root", tmp_path / "data", "--out", tmp_path / "out").exit_code == 0
    for config in reproduction.TABLE_CONFIGS:
        folder = tmp_path / "out" / "fr3_w_xyz" / config / "seed0"
        assert load_config(folder / "config.yaml") == load_config(CONFIGS[config])


def test_folder_to_which_a_batch_writes_is_error(server: str, fake_runs: list[str], tmp_path: Path) -> None:
    with lock_results(tmp_path / "out"):
        result = call("--data-root", tmp_path / "data", "--out", tmp_path / "out", "--resume")
    assert_error_line(result, f"{tmp_path / 'out'}: another run or batch is writing to this folder")
    assert not fake_runs


# --- bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--no-download",), ("missing sequences: rgbd_dataset_freiburg3_sitting_xyz, ", "freiburg3/, unpack", "data")),
        (("--configs", "papper"), ("papper", "paper")),
        (("--resume",), ("--resume", "--out")),
    ],
)
def test_bad_input_is_one_line(
    arguments: tuple[str, ...], words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("V3D_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    assert_error_line(call("--data-root", tmp_path / "data", *arguments), *words)
    assert not (tmp_path / "results").exists()


def test_damaged_sequence_is_an_error(server: str, fake_runs: list[str], tmp_path: Path) -> None:
    folder = tmp_path / "data" / SERVED[0]
    folder.mkdir(parents=True)
    assert_error_line(call("--data-root", tmp_path / "data", "--out", tmp_path / "out"), folder)
    assert not fake_runs


def test_damaged_ground_truth_is_an_error(server: str, fake_runs: list[str], tmp_path: Path) -> None:
    assert call("--data-root", tmp_path / "data", "--out", tmp_path / "first", "--seeds", "1").exit_code == 0
    fake_runs.clear()
    truth = tmp_path / "data" / SERVED[0] / "groundtruth.txt"
    truth.write_text("1 2 3\n")
    done = call("--data-root", tmp_path / "data", "--out", tmp_path / "second")
    assert_error_line(done, f"{truth}: line 1 is '1 2 3'")
    assert not fake_runs
