"""Planning of a batch."""

from __future__ import annotations

from pathlib import Path

from v3d_torch.batch.plan import load_configs
from v3d_torch.config.loading import load_config


def test_load_configs_drops_repetitions_and_limits_threads(tmp_path: Path) -> None:
    mine = str(tmp_path / "mine.yaml")
    Path(mine).write_text("seed: 7\nthreads: 2\nsegmentation: {threads: 2}\n")
    configs = load_configs(["full", "full", mine], one_thread=False)
    assert list(configs) == ["full", "mine"] and configs["full"] == load_config()
    one, two = load_configs([mine], one_thread=True)["mine"], configs["mine"]
    assert [(config.threads, config.segmentation.threads) for config in (one, two)] == [(1, 1), (2, 2)]
