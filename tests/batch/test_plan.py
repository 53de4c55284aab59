"""Planning of a batch."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.tum_folder_with_person import write_walker

from v3d_torch.batch.plan import check_configs, load_configs, plan_jobs
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.errors import ConfigError
from v3d_torch.runs.open_sequences import OpenedSequence
from v3d_torch.runs.request import RunRequest


def test_load_configs_drops_repetitions_and_limits_threads(tmp_path: Path) -> None:
    mine = str(tmp_path / "mine.yaml")
    Path(mine).write_text("seed: 7\nthreads: 2\nsegmentation: {threads: 2}\n")
    configs = load_configs(["full", "full", mine], one_thread=False)
    assert list(configs) == ["full", "mine"] and configs["full"] == load_config()
    one, two = load_configs([mine], one_thread=True)["mine"], configs["mine"]
    assert [(config.threads, config.segmentation.threads) for config in (one, two)] == [(1, 1), (2, 2)]


@pytest.mark.parametrize("order", [1, -1])
def test_configuration_that_two_paths_name_is_loaded_once(tmp_path: Path, order: int) -> None:
    for name in ("mine.yaml", "sub/mine.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("threads: 2\n")
    same = [str(tmp_path / "mine.yaml"), str(tmp_path / "sub" / ".." / "mine.yaml")]
    assert list(load_configs(same[::order], one_thread=False)) == ["mine"]
    with pytest.raises(ConfigError, match="another configuration is also named mine; rename the file"):
        load_configs([same[0], str(tmp_path / "sub" / "mine.yaml")], one_thread=False)


def test_configuration_without_map_is_rejected() -> None:
    check_configs(["full"], {"full": load_config()})
    with pytest.raises(ConfigError, match=r"^mapping\.enabled=false: there is no map to localise in; only `run` takes"):
        check_configs(["full"], {"full": load_config(overrides="mapping.enabled=false")})


def test_configuration_with_a_seed_is_rejected_by_its_file(tmp_path: Path) -> None:
    check_configs(["full"], {"full": load_config(overrides="seed=0")})
    mine = str(tmp_path / "mine.yaml")
    Path(mine).write_text("seed: 5\n")
    message = f"{mine}: has seed=5, but batch and ablate set the seeds 0, 1, ...; remove it, and use --seeds"
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}$"):
        check_configs(["full", mine], load_configs(["full", mine], one_thread=False))


def test_jobs_store_the_folder_of_the_variable_for_other_machines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = load_sequence(str(write_walker(tmp_path / "own", 2)))
    configs = load_configs(["baseline"], one_thread=True)
    monkeypatch.setenv("V3D_DATA", str(tmp_path))
    sequences = {"own": OpenedSequence(RunRequest("own", load_config()), sequence)}
    [job] = plan_jobs(sequences, configs, seeds=1, folder=tmp_path / "out")
    assert (job.request.seq, job.request.data_root) == ("own", str(tmp_path))
