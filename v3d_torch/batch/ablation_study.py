"""Ablation study: every variant of the system with every seed on every sequence, one run after the other."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from v3d_torch.batch.batch_folder import RUNS_TABLE, STUDY_TABLE
from v3d_torch.batch.plan import check_configs
from v3d_torch.batch.wide_console import wide_console
from v3d_torch.config import Config, SegmentationConfig
from v3d_torch.config.loading import find_config, load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.errors import ConfigError, InputError, OutputError, RunError
from v3d_torch.evaluation.ablation import (
    LEGEND,
    PAPER_RESULTS,
    VARIANTS,
    format_csv,
    format_markdown,
    make_screen_table,
)
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.io.files import write_text
from v3d_torch.io.names import folder_name
from v3d_torch.io.text import describe_error
from v3d_torch.runs.console import run_with_progress
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.open_sequences import OpenedSequence, open_sequences
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_folder import lock_results, make_result_folder
from v3d_torch.runs.run import Run
from v3d_torch.segmentation import make_instance_source, make_segmenter, wrap_upright
from v3d_torch.types import Instances, RGBDFrame, Segmenter

_NOTE = (
    "Variants with the same input of the network shared its results, and all runs shared one process: times and memory"
    " in their metrics.json are not those of a single run."
)


class CachedSegmenter:
    """Segmenter that computes the instances of each frame once and then returns identical copies.

    Most variants of a study differ only after the network, and the network takes most of the time of a run.

    Args:
        segment: Segmenter to cache.

    Attributes:
        wrapped: The segmenter to cache.
    """

    def __init__(self, segment: Segmenter) -> None:
        self.wrapped = segment
        self._cache: dict[tuple[int, int], Instances] = {}

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Return the instances of a frame. The cache key is index and image, because the image may be rotated."""
        key = (frame.index, hash(frame.image.numpy().tobytes()))
        if key not in self._cache:
            instances = self.wrapped(frame)
            packed = np.packbits(instances.masks.numpy(), axis=-1)  # eight pixels per byte, to save memory
            self._cache[key] = replace(instances, masks=torch.from_numpy(packed))
        cached = self._cache[key]
        masks = np.unpackbits(cached.masks.numpy(), axis=-1, count=frame.image.shape[-1]).astype(bool)
        return replace(cached, masks=torch.from_numpy(masks))


def run_ablation_study(
    names: Sequence[str],
    variants: Sequence[str],
    *,
    seeds: int,
    overrides: Sequence[str],
    data_root: Path | None,
    camera: str | None,
    fps: float | None,
    out: Path | None,
) -> None:
    """Run the study, show and write its tables; arguments as in ``v3d-torch ablate --help``.

    Raises:
        V3DError: If the input is invalid, if the folder contains an earlier study or a batch, or another study writes
            to it, if the study was interrupted, or if a run failed or has incomplete results. The results of the other
            runs are written.
    """
    console = wide_console()
    variant_configs = {variant: load_config(_find_variant(variant), overrides) for variant in variants}
    check_configs(variants, variant_configs)
    configs = {
        (variant, seed): config.model_copy(update={"seed": seed})
        for variant, config in variant_configs.items()
        for seed in range(seeds)
    }
    if out is not None:
        _check_folder(out)  # before sequences are opened, which can download them
    requests = [RunRequest.of_sequence(name, data_root, camera=camera, fps=fps) for name in names]
    sequences = open_sequences(requests, console)
    network = cache(make_instance_source)
    first_camera = next(iter(sequences.values())).sequence.camera
    for config in configs.values():  # a missing segmenter is an error before the first run
        if config.stages.segment is None:
            network(_network_config(config))
        else:
            make_segmenter(config, first_camera)
    _check_differences(variant_configs, overrides)
    folder = make_result_folder(out, "ablation")
    with lock_results(folder):
        outcomes = _run_variants(folder, sequences, configs, network, console)
    console.print(f"{LEGEND}\n{PAPER_RESULTS}", markup=False)
    print_line(console, f"results: {folder}")
    if failed := [outcome for outcome in outcomes if outcome.failure is not None]:
        raise RunError(f"{len(failed)} of {len(outcomes)} runs failed, the first: {failed[0]}")
    if incomplete := [outcome for outcome in outcomes if outcome.diagnosis is not None]:
        raise RunError(f"{len(incomplete)} of {len(outcomes)} runs have incomplete results, the first: {incomplete[0]}")


def _run_variants(
    folder: Path,
    sequences: Mapping[str, OpenedSequence],
    configs: Mapping[tuple[str, int], Config],
    network: Callable[[SegmentationConfig], Segmenter],
    console: Console,
) -> list[Outcome]:
    """Run each configuration, given by variant and seed, on each sequence; write the tables after each run.

    Args:
        folder: Folder of the study.
        sequences: Sequences by the name in tables, each with the request of its runs.
        configs: Configurations by variant and seed.
        network: Function that returns the network of a configuration.
        console: Console for progress and tables.
    """
    _check_folder(folder)
    outcomes: list[Outcome] = []
    try:
        for name, opened in sequences.items():
            cached: dict[SegmentationConfig, Segmenter] = {}
            for (variant, seed), config in configs.items():
                if config.stages.segment is None:
                    key = _network_config(config)
                    segment = wrap_upright(cached.setdefault(key, CachedSegmenter(network(key))), config.segmentation)
                else:
                    segment = make_segmenter(config, opened.sequence.camera)
                run_folder = make_result_folder(folder / folder_name(name) / variant / f"seed{seed}", name)
                request = replace(opened.request, config=config)
                metrics, failure = _run(request, opened.sequence, segment, run_folder, console)
                outcomes.append(Outcome(name, variant, seed, metrics, failure))
                print_line(console, str(outcomes[-1]))
                write_text(folder / "ablation.md", format_markdown(outcomes, _NOTE))
                write_text(folder / STUDY_TABLE, format_csv(outcomes))
            console.print(make_screen_table([outcome for outcome in outcomes if outcome.sequence == name]))
    except KeyboardInterrupt as interrupt:
        done, total = len(outcomes), len(configs) * len(sequences)
        raise RunError(f"interrupted after {done} of {total} runs; their results are in {folder}") from interrupt
    return outcomes


def _check_folder(folder: Path) -> None:
    """Check that a folder has no results of other runs.

    Raises:
        InputError: If it has.
    """
    for table, contents in ((STUDY_TABLE, "an earlier study"), (RUNS_TABLE, "a batch")):
        if (folder / table).exists():
            raise InputError(f"{folder}: contains {contents}; choose another folder with --out")


def _check_differences(configs: Mapping[str, Config], overrides: Sequence[str]) -> None:
    """Check that no value given with ``--set`` makes two variants equal.

    Raises:
        ConfigError: If it does.
    """
    for first, second in combinations(configs, 2):
        if configs[first] == configs[second]:
            raise ConfigError(
                f"--set {' '.join(overrides)}: {first} and {second} are then the same; remove one of them"
            )


def _find_variant(name: str) -> Path:
    if name not in VARIANTS:
        raise ConfigError(f"--variants {name}: unknown variant; choose from {', '.join(VARIANTS)}")
    return find_config(name)


def _network_config(config: Config) -> SegmentationConfig:
    """Return the configuration of the network alone: images are rotated upright before the network."""
    return config.segmentation.model_copy(update={"upright": False})


def _run(
    request: RunRequest, sequence: RGBDSequence, segment: Segmenter, folder: Path, console: Console
) -> tuple[dict[str, object], str | None]:
    """Run a sequence and write the results.

    Returns:
        Metrics and error message of the run; the metrics are empty if the run failed, the message is None if it
        succeeded.

    Raises:
        KeyboardInterrupt: If the user interrupted the run.
        OutputError: If the results cannot be written.
    """
    try:
        pipeline, _ = run_with_progress(
            lambda: Run(request, sequence, segment, folder, save_checkpoints=False), sequence, folder, console
        )
    except OutputError:
        raise
    except Exception as error:  # continue the study after an error in one variant; its log has the traceback
        return {}, describe_error(error)
    if pipeline.record.interrupted:
        raise KeyboardInterrupt
    if pipeline.record.failure is not None:
        return {}, pipeline.record.failure
    return json.loads((folder / RunFile.METRICS).read_text(encoding="utf-8")), None
