"""Option ``--skip-broken``: broken frames are skipped, up to a limit."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Event

import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers.commands import assert_error_line, assert_same_results, invoke
from helpers.corpus import base
from helpers.corpus.outputs import at_frame
from helpers.tum_folder_with_person import write_walker
from typer.testing import Result

from v3d_torch.batch import runner
from v3d_torch.batch.executor import JobFinished
from v3d_torch.batch.job import Job
from v3d_torch.batch.run_job import run_job
from v3d_torch.cli import batch, run
from v3d_torch.datasets.broken_frames import max_broken_frames

pytestmark = pytest.mark.usefixtures("no_figures")

FRAMES = 16
BROKEN = {
    0: "rgb/1305031102.000000.png: is truncated or damaged",
    3: "depth/1305031102.300000.png: is listed but does not exist",
    4: "rgb/1305031102.400000.png: is not a PNG, JPEG or TIFF image",
    9: "depth/1305031102.900000.png: has 40x30 pixels",
    15: "depth/1305031103.500000.png: is an 8-bit image",
}
"""Broken frames of the sequence, and the beginning of their messages."""

GOOD = [index for index in range(FRAMES) if index not in BROKEN]


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sequence with frames that are broken in all ways, also the first and the last."""
    folder = write_walker(tmp_path_factory.mktemp("broken") / "seq", FRAMES)
    colour, depth = (sorted((folder / kind).iterdir()) for kind in ("rgb", "depth"))
    colour[0].write_bytes(colour[0].read_bytes()[:200])
    depth[3].unlink()
    colour[4].write_bytes(b"")
    depth[9].write_bytes(base.png(base.depth()[:30, :40]))
    depth[15].write_bytes(base.png(np.zeros((base.HEIGHT, base.WIDTH), np.uint8)))
    return folder


def call(sequence: Path, out: Path, *more: str) -> Result:
    return invoke(run.app, "--seq", sequence, "--masks", sequence / "ids", "--out", out, *more, COLUMNS="400")


@pytest.fixture(scope="module")
def serial(broken: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    out = tmp_path_factory.mktemp("serial") / "out"
    return out, call(broken, out, "--skip-broken", "--serial")


def test_broken_frames_are_skipped_and_counted(broken: Path, serial: tuple[Path, Result]) -> None:
    out, done = serial
    assert (done.exit_code, done.stderr) == (0, "")
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["frames"], metrics["processed"], metrics["skipped"]) == (FRAMES, len(GOOD), len(BROKEN))
    assert metrics["coverage"] == pytest.approx(len(GOOD) / FRAMES) and metrics["failure"] is None
    stamps = [line.split()[0] for line in (broken / "rgb.txt").read_text().splitlines()]
    rows = (out / "trajectory.txt").read_text().splitlines()
    assert [row.split()[0] for row in rows] == [stamps[index] for index in GOOD]
    assert pq.read_table(out / "frames.parquet")["frame"].to_pylist() == GOOD
    assert metrics["ate"]["rmse"] < 0.005


def test_each_broken_frame_has_one_warning_on_the_console_and_in_the_log(
    broken: Path, serial: tuple[Path, Result]
) -> None:
    out, done = serial
    log = (out / "run.log").read_text()
    for index, reason in BROKEN.items():
        warning = f"frame {index} is broken and skipped: {broken}/{reason}"
        assert done.stdout.count(f"warning: {warning}") == log.count(f"WARNING {warning}") == 1
    assert done.stdout.count("warning: ") == log.count(" WARNING ") == len(BROKEN)
    assert f"{len(GOOD)} of {FRAMES}, {len(BROKEN)} broken and skipped" in done.stdout


def test_threads_give_the_same_bytes(broken: Path, serial: tuple[Path, Result], tmp_path: Path) -> None:
    done = call(broken, tmp_path / "out", "--skip-broken")
    assert done.exit_code == 0, done.stderr
    assert_same_results(tmp_path / "out", serial[0])


@pytest.mark.skipif(os.name == "nt", reason="no SIGINT to itself")
@pytest.mark.parametrize("stop", [2, 5, 8, 14])
def test_interrupted_run_resumes_to_the_same_bytes(
    stop: int, broken: Path, serial: tuple[Path, Result], tmp_path: Path
) -> None:
    with at_frame(stop, lambda: os.kill(os.getpid(), signal.SIGINT)):
        assert_error_line(call(broken, tmp_path / "out", "--skip-broken"), "interrupted after")
    done = invoke(run.app, "--resume", tmp_path / "out")
    assert done.exit_code == 0, done.stderr
    assert_same_results(tmp_path / "out", serial[0])


def test_run_that_a_broken_frame_ended_resumes_and_passes_it_over(tmp_path: Path) -> None:
    sequence, out = write_walker(tmp_path / "seq", FRAMES), tmp_path / "out"
    frame = sorted((sequence / "rgb").iterdir())[6]
    frame.write_bytes(frame.read_bytes()[:100])
    assert_error_line(call(sequence, out), str(frame), "the results of the 6 frames before", f"--resume {out}")
    done = invoke(run.app, "--resume", out, "--skip-broken")
    assert done.exit_code == 0, done.stderr
    assert call(sequence, tmp_path / "expected", "--skip-broken").exit_code == 0
    assert_same_results(out, tmp_path / "expected")


def test_run_without_the_option_does_not_start_if_a_file_is_missing(broken: Path, tmp_path: Path) -> None:
    done = call(broken, tmp_path / "out")
    assert_error_line(done, f"{broken}/depth/1305031102.300000.png: is listed but does not exist (1 missing in total)")


def test_too_many_broken_frames_end_the_run_and_keep_its_results(tmp_path: Path) -> None:
    sequence, out = write_walker(tmp_path / "seq", 18), tmp_path / "out"
    for path in sorted((sequence / "depth").iterdir())[4:16]:
        path.unlink()
    done = call(sequence, out, "--skip-broken")
    last = f"{sequence}/depth/1305031103.400000.png: is listed but does not exist; copy the whole sequence again"
    assert_error_line(
        done,
        f"error: {last}; 11 of 18 frames are broken, and --skip-broken skips at most 10 (the results of the 4"
        f" frames before are in {out}; resume with --resume {out})",
    )
    assert len((out / "trajectory.txt").read_text().splitlines()) == 4
    assert json.loads((out / "metrics.json").read_text())["processed"] == 4


def test_sequence_without_readable_frames_is_rejected(tmp_path: Path) -> None:
    sequence = write_walker(tmp_path / "seq", 12)
    shutil.rmtree(sequence / "depth")
    done = call(sequence, tmp_path / "out", "--skip-broken")
    assert_error_line(done, f"{sequence}/depth/1305031103.000000.png: is listed but does not exist")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("frames", "limit"), [(1, 10), (200, 10), (219, 10), (220, 11), (5000, 250)])
def test_limit_is_a_fraction_of_the_frames_but_at_least_ten(frames: int, limit: int) -> None:
    assert max_broken_frames(frames) == limit


def execute(jobs: Sequence[Job], stop: Event) -> Iterator[JobFinished]:
    """Run jobs in this process."""
    yield from (JobFinished(job, run_job(job, lambda _: None)) for job in jobs)


def test_batch_passes_over_broken_frames_and_keeps_finished_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "ProcessExecutor", lambda workers: execute)
    good = write_walker(tmp_path / "good", 6)
    bad = write_walker(tmp_path / "bad", 6)
    frame = sorted((bad / "rgb").iterdir())[4]
    frame.write_bytes(b"")

    def call_batch(*more: str) -> Result:
        arguments = ["--seqs", str(good), str(bad), "--configs", "baseline", "--out", str(tmp_path / "out")]
        return invoke(batch.app, *arguments, *more, V3D_DATA="", NO_COLOR="1")

    done = call_batch()
    assert_error_line(done, "1 of 2 runs failed", "again, with --skip-broken if broken frames ended them")
    assert str(frame) in done.stdout
    finished = (tmp_path / "out" / "good" / "baseline" / "seed0" / "metrics.json").stat().st_mtime_ns
    done = call_batch("--resume", "--skip-broken")
    assert done.exit_code == 0, done.stderr
    assert "bad, baseline, seed 0: ATE" in done.stdout and "m, 1 broken frame skipped" in done.stdout
    assert (tmp_path / "out" / "good" / "baseline" / "seed0" / "metrics.json").stat().st_mtime_ns == finished
    log = (tmp_path / "out" / "bad" / "baseline" / "seed0" / "run.log").read_text()
    assert "resumed after 4 frames" in log and log.count("is broken and skipped") == 1
    runs = pq.read_table(tmp_path / "out" / "runs.parquet").to_pandas().set_index("sequence")
    assert runs["skipped"].to_dict() == {"good": 0, "bad": 1}
    # A run that skipped frames is finished, and is not run again.
    assert call_batch("--resume").exit_code == 0
