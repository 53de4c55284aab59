"""Batches on a Ray cluster: two nodes of one core each, started on this machine."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import pandas as pd
import psutil
import pytest
from helpers.batches import jobs, repeated
from typer.testing import CliRunner

from v3d_torch.batch.executor import Finished
from v3d_torch.batch.job import Job
from v3d_torch.batch.job_process import run_job
from v3d_torch.batch.ray_cluster import RayCluster
from v3d_torch.cli.batch import app
from v3d_torch.errors import InputError

if TYPE_CHECKING:
    from ray.cluster_utils import Cluster as Nodes


def test_without_ray_there_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    result = CliRunner().invoke(app, ["--seqs", "demo", "--ray", "auto"])
    assert result.exit_code == 2
    assert result.stderr == "error: --ray: Ray is not installed; pip install 'v3d-torch[ray]'\n"


@pytest.fixture(scope="module")
def nodes() -> Iterator[Nodes]:
    """Two nodes; they end with the tests."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'v3d-torch[ray]'")
    from ray.cluster_utils import Cluster as Nodes

    cluster = Nodes(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    yield cluster
    cluster.shutdown()


def test_a_batch_on_a_cluster_gives_what_it_gives_here(nodes: Nodes, moment: Path, tmp_path: Path) -> None:
    arguments = ["--seqs", str(moment), "--configs", "baseline", "--seeds", "2", "--out", str(tmp_path / "there")]
    result = CliRunner().invoke(app, [*arguments, "--ray", nodes.address])
    assert result.exit_code == 0, result.output
    table = pd.read_parquet(tmp_path / "there" / "runs.parquet")
    assert table["seed"].tolist() == [0, 1] and (table["tracked"] == 6).all()
    (job,) = jobs(moment, tmp_path / "here", seeds=1)
    assert run_job(job, lambda frames: None) is None
    for name in ("trajectory.txt", "keyframes.txt", "dynamics.parquet", "map.ply", "config.yaml"):
        there = tmp_path / "there" / "moment" / "baseline" / "seed0" / name
        assert there.read_bytes() == (job.folder / name).read_bytes(), name


def pid_of(job: Job) -> int:
    """The process, among those that these tests have started, that writes a job's log."""
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if any(Path(file.path) == job.folder / "run.log" for file in process.open_files()):
                return process.pid
    raise AssertionError(f"nobody runs {job}")


def test_one_dies_one_ends_the_rest_is_stopped(nodes: Nodes, moment: Path, tmp_path: Path) -> None:
    """Of four jobs on two cores the first is killed; when another has ended and one still runs the batch is stopped."""
    planned = jobs(repeated(moment, tmp_path / "long", frames=30), tmp_path / "out", seeds=4)
    stop = Event()
    began: set[int] = set()
    ends: dict[int, str | None] = {}
    killed = None
    for event in RayCluster(nodes.address)(planned, stop):
        seed = event.job.config.seed
        if isinstance(event, Finished):
            ends[seed] = event.failure
        else:
            began.add(seed)
            assert len(began - set(ends)) <= 2
            if killed is None and event.frames:
                killed = seed
                os.kill(pid_of(event.job), signal.SIGKILL)
            elif event.frames and None in ends.values():
                stop.set()
    assert killed is not None and "died unexpectedly" in str(ends[killed])
    good = [seed for seed, failure in ends.items() if failure is None]
    stopped = [seed for seed, failure in ends.items() if failure is not None and "interrupted after" in failure]
    assert good and stopped and len(good) + len(stopped) == len(ends) - 1
    for job in planned:
        finished = job.finished()
        assert (finished is not None) == (job.config.seed in good)
        if job.config.seed in stopped:
            assert (job.folder / "trajectory.txt").read_text() and (job.folder / "metrics.json").is_file()


@pytest.mark.parametrize("address", ["nonsense", "127.0.0.1:1", "ray://127.0.0.1:1"])
def test_a_cluster_that_is_not_there(address: str) -> None:
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'v3d-torch[ray]'")
    with pytest.raises(InputError, match=rf"--ray {address}: there is no such cluster \(.+\); .*ray start"):
        RayCluster(address)
