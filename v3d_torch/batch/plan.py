"""Jobs of a batch: every sequence with every configuration and every seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from v3d_torch.batch.job import Job, single_threaded
from v3d_torch.config import Config, SegmentationConfig
from v3d_torch.config.loading import find_config, load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.datasets.locate import data_root_of
from v3d_torch.datasets.sequence_digest import sequence_digest
from v3d_torch.errors import ConfigError
from v3d_torch.io.names import folder_name
from v3d_torch.io.paths import expand_user
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
    sequences: Mapping[str, tuple[str, RGBDSequence]],
    configs: Mapping[str, Config],
    *,
    seeds: int,
    data_root: Path | None,
    folder: Path,
    skip_broken: bool = False,
) -> list[Job]:
    """Return the jobs of a batch, ordered by sequence, configuration and seed.

    Args:
        sequences: Source (path or name) and opened sequence, by the name in tables.
        configs: Configurations by the name in tables.
        seeds: Number of runs for each sequence and configuration; their seeds count from 0.
        data_root: Folder of named sequences; None for ``$V3D_DATA``, which is stored in the jobs of sequences in it.
        folder: Folder of the batch. A run writes to ``<sequence>/<configuration>/seed<k>`` in it.
        skip_broken: True if runs skip broken frames.
    """
    digests = {name: sequence_digest(sequence) for name, (_, sequence) in sequences.items()}
    return [
        Job(
            sequence=name,
            source=str(path.absolute()) if (path := expand_user(source)).exists() else source,
            frames=len(sequence),
            digest=digests[name],
            data_root=data_root_of(source, data_root),  # other machines may lack the variable
            config_name=label,
            config=config.model_copy(update={"seed": seed}),
            folder=folder.absolute() / folder_name(name) / label / f"seed{seed}",
            skip_broken=skip_broken,
        )
        for name, (source, sequence) in sequences.items()
        for label, config in configs.items()
        for seed in range(seeds)
    ]
