"""The system of a run: with the checks that the configuration asks for, and only with a map if it needs one."""

from __future__ import annotations

import torch

from v3d_torch.config import Config
from v3d_torch.errors import ConfigError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.runs.numerics_check import CheckedSLAM
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Segmenter


def make_system(
    camera: PinholeCamera, segment: Segmenter, config: Config, known_map: SparseMap | None = None
) -> V3DSLAM:
    """Make the system that all commands run: `CheckedSLAM` if ``check_numerics`` is set, else `V3DSLAM`.

    The number of threads and the seed of torch are set as the configuration states them.

    Args:
        camera: Camera of all frames.
        segment: Segmenter.
        config: Configuration of all stages.
        known_map: Map of an earlier run in which the camera is localised; None to start a new map.

    Raises:
        ConfigError: As `V3DSLAM`.
    """
    set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    return (CheckedSLAM if config.check_numerics else V3DSLAM)(camera, segment, config, known_map)


def check_map_is_given(config: Config, load_map: str | None = None) -> None:
    """Check, before the inputs of a run are opened, that it has a map if it starts none.

    Args:
        config: Configuration of the run.
        load_map: Map file in which the camera is localised; None to start a new map.

    Raises:
        ConfigError: If ``mapping.enabled`` is false and there is no map file.
    """
    if load_map is None and not config.mapping.enabled:
        raise ConfigError(
            "mapping.enabled=false: there is no map to localise in; only `run` takes one, with --load-map"
        )
