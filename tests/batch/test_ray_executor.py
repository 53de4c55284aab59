"""Batches on a Ray cluster: two nodes of one core each, started on this machine."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import pandas as pd
import psutil
import pytest
from helpers.batches import plan_seeds, repeat_sequence
from helpers.own_stages import MODULE, write_own_stages
from typer.testing import CliRunner

from v3d_torch.batch.executor import JobFinished, JobProgress, JobRepeated
from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.batch.ray_executor import RayExecutor
from v3d_torch.batch.run_job import run_job
from v3d_torch.cli.batch import app
from v3d_torch.config.loading import load_config
from v3d_torch.errors import InputError

if TYPE_CHECKING:
    from ray.cluster_utils import Cluster as Nodes


def test_missing_ray_is_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    result = CliRunner().invoke(app, ["--seqs", "demo", "--ray", "auto"])
    assert result.exit_code == 2
    assert result.stderr == "error: --ray: Ray is not installed; pip install 'v3d-torch[ray]'\n"


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a module with stages."""
    return write_own_stages(tmp_path_factory.mktemp("own"))


@pytest.fixture(scope="module")
def nodes(own: Path) -> Iterator[Nodes]:
    """Cluster of two nodes, started with the module's folder in PYTHONPATH, and shut down after the tests."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'v3d-torch[ray]'")
    from ray.cluster_utils import Cluster as Nodes

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(own), prepend=os.pathsep)
        patch.setenv("RAY_worker_niceness", "0")  # by default, jobs wait for the other tests
        cluster = Nodes(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        cluster.add_node(num_cpus=1)
        yield cluster
        cluster.shutdown()


def test_results_on_cluster_with_a_stage_of_the_configuration_are_identical_to_local_results(
    nodes: Nodes, own: Path, moment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(own)  # the processes of the cluster have the folder in PYTHONPATH
    (tmp_path / "lab.yaml").write_text(f"stages:\n  segment: {MODULE}:Corner\n")
    arguments = ["--seqs", moment, "--configs", tmp_path / "lab.yaml", "--out", tmp_path / "cluster"]
    result = CliRunner().invoke(app, [*map(str, arguments), "--ray", nodes.address])
    assert result.exit_code == 0, result.output
    table = pd.read_parquet(tmp_path / "cluster" / "runs.parquet")
    assert table["seed"].tolist() == [0] and (table["tracked"] == 6).all()
    (job,) = plan_seeds(moment, tmp_path / "local", seeds=1)
    config = single_threaded(load_config(tmp_path / "lab.yaml"))
    assert run_job(replace(job, request=replace(job.request, config=config)), lambda frames: None) is None
    remote = tmp_path / "cluster" / "moment" / "lab" / "seed0"
    for name in ("trajectory.txt", "keyframes.txt", "objects.parquet", "map.ply", "config.yaml"):
        assert (remote / name).read_bytes() == (job.folder / name).read_bytes(), name
    assert json.loads((remote / "metrics.json").read_text())["stages"] == {"segment": f"{MODULE}:Corner"}
    del sys.modules[MODULE]  # other tests import it from other folders


def find_process(job: Job) -> int | None:
    """Return the id of the process, among those started by these tests, that has the log of a job open, if any."""
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if any(Path(file.path) == job.folder / "run.log" for file in process.open_files()):
                return process.pid
    return None  # it has just been killed


def test_killed_jobs_are_run_once_more(nodes: Nodes, moment: Path, tmp_path: Path) -> None:
    """Kill one of two jobs twice and the other one once."""
    planned = plan_seeds(repeat_sequence(moment, tmp_path / "long", frames=30), tmp_path / "out", seeds=2)
    limits = {0: 2, 1: 1}
    kills: Counter[int] = Counter()
    repeated: list[JobRepeated] = []
    ends: dict[int, str | None] = {}
    for event in RayExecutor(nodes.address)(planned, Event()):
        seed = event.job.config.seed
        if isinstance(event, JobFinished):
            ends[seed] = event.failure
        elif isinstance(event, JobRepeated):
            repeated.append(event)
        elif event.frames and kills[seed] < limits[seed] and (process := find_process(event.job)) is not None:
            kills[seed] += 1
            os.kill(process, signal.SIGKILL)
    assert kills == limits and ends[1] is None and "died unexpectedly" in str(ends[0])
    assert sorted(event.job.config.seed for event in repeated) == [0, 1]
    assert all(str(event).endswith("; it is run once more") for event in repeated)
    assert (planned[0].folder / "run.log").read_text().splitlines()[-1].endswith(f"ERROR {ends[0]}")
    assert [job.earlier_outcome() is not None for job in planned] == [False, True]


def test_stop_ends_running_jobs(nodes: Nodes, moment: Path, tmp_path: Path) -> None:
    planned = plan_seeds(repeat_sequence(moment, tmp_path / "long", frames=120), tmp_path / "out", seeds=2)
    stop, ends = Event(), []
    for event in RayExecutor(nodes.address, workers=1)(planned, stop):
        if isinstance(event, JobFinished):
            ends.append(event)
        elif isinstance(event, JobProgress) and event.frames:
            stop.set()
    (ended,) = ends
    assert "interrupted after" in str(ended.failure) and all(job.earlier_outcome() is None for job in planned)
    assert (ended.job.folder / "trajectory.txt").read_text() and (ended.job.folder / "metrics.json").is_file()


@pytest.mark.parametrize("address", ["nonsense", "127.0.0.1:1", "ray://127.0.0.1:1"])
def test_unreachable_cluster_is_error(address: str) -> None:
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'v3d-torch[ray]'")
    with pytest.raises(InputError, match=rf"--ray {address}: no Ray cluster found \(.+\); .*ray start"):
        RayExecutor(address)
