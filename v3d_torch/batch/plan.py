"""Jobs of a batch: every sequence with every configuration and every seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.config import Config, SegmentationConfig
from v3d_torch.config.loading import find_config, load_config
from v3d_torch.datasets.sequence_digest import sequence_digest
from v3d_torch.errors import ConfigError
from v3d_torch.io.names import folder_name
from v3d_torch.runs.open_sequences import OpenedSequence
from v3d_torch.runs.system import check_map_is_given
from v3d_torch.runtime.stage_import import import_stage
from v3d_torch.segmentation import make_instance_source


def load_configs(names: Sequence[str], *, one_thread: bool) -> dict[str, Config]:
    """Load configurations.

    Args:
        names: Names or files, see `find_config`. Duplicates are loaded once.
        one_thread: True to limit each run to one thread, for runs that share a machine.

    Returns:
        Configurations by their name in tables, which is the file name without suffix.

    Raises:
        ConfigError: If a configuration is missing or invalid, or if two different ones have the same name.
    """
    paths: dict[str, Path] = {}
    for name in names:
        path = find_config(name)
        if paths.setdefault(path.stem, path).resolve() != path.resolve():
            raise ConfigError(f"{name}: another configuration is also named {path.stem}; rename the file")
    configs = {label: load_config(path) for label, path in paths.items()}
    return {label: single_threaded(config) for label, config in configs.items()} if one_thread else configs


def check_configs(names: Sequence[str], configs: Mapping[str, Config]) -> None:
    """Check that configurations set no seed, which the batch sets, and need no inputs of a single run.

    Args:
        names: Names or files of the configurations, as given by the user.
        configs: Configurations by their name in tables.

    Raises:
        ConfigError: If a configuration sets another seed than the default, or localises the camera in a map.
    """
    for name in names:
        config = configs[find_config(name).stem]
        check_map_is_given(config)
        if config.seed != Config().seed:
            raise ConfigError(
                f"{name}: has seed={config.seed}, but batch and ablate set the seeds 0, 1, ...; remove it, and use"
                " --seeds"
            )


def prepare_stages(configs: Mapping[str, Config]) -> None:
    """Import the stages that the configurations name, and download and export their networks, before the first run.

    Raises:
        WeightsError: If the weights of a network are not available.
        ConfigError: If a configuration reads masks from files, which belong to one sequence, or if a stage cannot be
            imported.
    """
    prepared: list[SegmentationConfig] = []
    for config in configs.values():
        for name, path in config.stages.paths.items():
            import_stage(name, path)
        if config.stages.segment is None and config.segmentation not in prepared:
            prepared.append(config.segmentation)
            make_instance_source(config.segmentation)


def plan_jobs(
    sequences: Mapping[str, OpenedSequence], configs: Mapping[str, Config], *, seeds: int, folder: Path
) -> list[Job]:
    """Return the jobs of a batch, ordered by sequence, configuration and seed.

    Args:
        sequences: Sequences by the name in tables, each with the request of its runs.
        configs: Configurations by the name in tables.
        seeds: Number of runs for each sequence and configuration; their seeds count from 0.
        folder: Folder of the batch. A run writes to ``<sequence>/<configuration>/seed<k>`` in it.
    """
    digests = {name: sequence_digest(opened.sequence) for name, opened in sequences.items()}
    # Absolute, because another machine may have another working directory and environment.
    requests = {name: opened.request.absolute() for name, opened in sequences.items()}
    return [
        Job(
            sequence=name,
            frames=len(opened.sequence),
            digest=digests[name],
            config_name=label,
            request=replace(requests[name], config=config.model_copy(update={"seed": seed})),
            folder=folder.absolute() / folder_name(name) / label / f"seed{seed}",
        )
        for name, opened in sequences.items()
        for label, config in configs.items()
        for seed in range(seeds)
    ]
