"""The runs that a batch is made of: every sequence with every configuration and every seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.config import Config, SegmentationConfig
from v3d_torch.config.loading import CONFIGS, FULL, find_config, load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.errors import ConfigError
from v3d_torch.io.paths import expand_user
from v3d_torch.segmentation import make_instance_source


def read_configs(names: Sequence[str], *, one_thread: bool) -> dict[str, Config]:
    """Configurations by their names in tables, which for a YAML file is its name without the suffix.

    Args:
        names: as `find_config` takes them, each once or more often.
        one_thread: whether runs share a machine, so that each has one thread.

    Raises:
        ConfigError: one is not there or wrong, or two different ones have the same name.
    """
    paths: dict[str, Path] = {}
    for name in names:
        path = find_config(name)
        label = FULL if path == CONFIGS[FULL] else path.stem
        if paths.setdefault(label, path).resolve() != path.resolve():
            raise ConfigError(f"{name}: another configuration is called {label} too; give the file another name")
    configs = {label: load_config(path) for label, path in paths.items()}
    return {label: single_threaded(config) for label, config in configs.items()} if one_thread else configs


def make_sure_of_networks(configs: Mapping[str, Config]) -> None:
    """Download and export what the configurations need, once and before the first run.

    Raises:
        WeightsError: if a network's weights cannot be had.
        ConfigError: if a configuration wants masks from files, which belong to one sequence.
    """
    needed: list[SegmentationConfig] = []
    for config in configs.values():
        if config.segmentation not in needed:
            needed.append(config.segmentation)
            make_instance_source(config.segmentation)


def plan(
    sequences: Mapping[str, tuple[str, RGBDSequence]],
    configs: Mapping[str, Config],
    *,
    seeds: int,
    data_root: Path | None,
    folder: Path,
) -> list[Job]:
    """The runs in the order of sequences, configurations and seeds.

    Args:
        sequences: what to open, and that opened, by the name for tables.
        configs: by the name for tables.
        seeds: number of runs of each, with seeds from 0.
        data_root: where named sequences are kept.
        folder: of the results; those of a run are in ``<sequence>/<configuration>/seed<k>`` in it.
    """
    return [
        Job(
            sequence=name,
            source=str(path.absolute()) if (path := expand_user(source)).exists() else source,
            frames=len(sequence),
            data_root=data_root.absolute() if data_root is not None else None,
            config_name=label,
            config=config.model_copy(update={"seed": seed}),
            folder=folder.absolute() / name.replace("/", "_") / label / f"seed{seed}",
        )
        for name, (source, sequence) in sequences.items()
        for label, config in configs.items()
        for seed in range(seeds)
    ]
