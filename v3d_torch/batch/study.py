"""The runs of the ablation study: every variant with every seed on every sequence, one after the other."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from v3d_torch.config import Config, SegmentationConfig
from v3d_torch.config.loading import find_config, load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.errors import ConfigError, InputError, OutputError
from v3d_torch.evaluation.ablation import LEGEND, PAPER_SAYS, VARIANTS, csv_text, markdown, screen_table
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.io.files import write_text
from v3d_torch.runs.console import open_sequences, run_with_progress, wide_console
from v3d_torch.runs.request import RunRequest
from v3d_torch.runs.result_folder import make_result_folder
from v3d_torch.runs.run import Run
from v3d_torch.segmentation import keep_upright, make_instance_source
from v3d_torch.types import Instances, RGBDFrame, Segmenter

_NOTE = (
    "The network ran once for each sequence and all runs were in one process: the times and the memory in their"
    " metrics.json are not those of a run alone."
)


class SegmentOnce:
    """Keeps what a segmenter says of each frame of a sequence, and says the same, bit for bit, when asked again.

    The network takes the most time of a run, and the variants differ only in what comes after it.
    """

    def __init__(self, segment: Segmenter) -> None:
        self._segment = segment
        self._kept: dict[tuple[int, int], Instances] = {}

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Instances of a frame; frames are told apart by index and image, which may have been turned."""
        key = (frame.index, hash(frame.image.numpy().tobytes()))
        if key not in self._kept:
            instances = self._segment(frame)
            packed = np.packbits(instances.masks.numpy(), axis=-1)  # eight pixels a byte, or a long sequence takes GBs
            self._kept[key] = replace(instances, masks=torch.from_numpy(packed))
        kept = self._kept[key]
        masks = np.unpackbits(kept.masks.numpy(), axis=-1, count=frame.image.shape[-1]).astype(bool)
        return replace(kept, masks=torch.from_numpy(masks))


def run_study(
    names: Sequence[str],
    variants: Sequence[str],
    *,
    seeds: int,
    overrides: Sequence[str],
    data_root: Path | None,
    out: Path | None,
) -> None:
    """Run the study with everything shown and written; see ``python -m v3d_torch ablate --help``.

    Raises:
        V3DError: on bad input, or when the study was interrupted or a run failed; what the others gave is written.
    """
    console = wide_console()
    configs = {
        (variant, seed): load_config(_file(variant), [*overrides, f"seed={seed}"])
        for variant in variants
        for seed in range(seeds)
    }
    sequences = open_sequences(names, data_root, console)
    network = cache(make_instance_source)
    for config in configs.values():
        network(_without_rotation(config))  # what cannot be had is said before the first run, not after hours
    folder = make_result_folder(out, "ablation")
    outcomes: list[Outcome] = []
    try:
        for name, sequence in sequences.items():
            sources: dict[SegmentationConfig, Segmenter] = {}
            for (variant, seed), config in configs.items():
                source = sources.setdefault(_without_rotation(config), SegmentOnce(network(_without_rotation(config))))
                segment = keep_upright(source, config.segmentation)
                place = make_result_folder(folder / name.replace("/", "_") / variant / f"seed{seed}", name)
                metrics, failure = _run(sequence, segment, config, place, console)
                outcomes.append(Outcome(name, variant, seed, metrics, failure))
                console.print(str(outcomes[-1]), markup=False)
                write_text(folder / "ablation.md", markdown(outcomes, _NOTE))
                write_text(folder / "ablation.csv", csv_text(outcomes))
            console.print(screen_table([outcome for outcome in outcomes if outcome.sequence == name]))
    except KeyboardInterrupt as interrupt:
        done, total = len(outcomes), len(configs) * len(sequences)
        raise InputError(f"interrupted after {done} of {total} runs; what they gave is in {folder}") from interrupt
    console.print(f"{LEGEND}\n{PAPER_SAYS}", markup=False)
    console.print(f"results: {folder}", markup=False)
    if failed := [outcome for outcome in outcomes if outcome.failure is not None]:
        raise InputError(f"{len(failed)} of {len(outcomes)} runs failed, the first: {failed[0]}")


def _file(variant: str) -> Path:
    if variant not in VARIANTS:
        raise ConfigError(f"--variants {variant}: there is no such variant; there are {', '.join(VARIANTS)}")
    return find_config(variant)


def _without_rotation(config: Config) -> SegmentationConfig:
    """What the network itself is told: images are turned, where they are, before it sees them."""
    return config.segmentation.model_copy(update={"upright": False})


def _run(
    sequence: RGBDSequence, segment: Segmenter, config: Config, folder: Path, console: Console
) -> tuple[dict[str, object], str | None]:
    """One run, its results written.

    Returns:
        Its metrics, or none of them and the sentence that it failed with.

    Raises:
        KeyboardInterrupt: the user ended it.
        OutputError: when the results cannot be written.
    """
    try:
        request = RunRequest(sequence.name, config)
        pipeline, _ = run_with_progress(
            lambda: Run(request, sequence, segment, folder, save_checkpoints=False), folder, console
        )
    except OutputError:
        raise
    except Exception as error:  # a variant that breaks must not cost the others; its log has the traceback
        return {}, f"{type(error).__name__}: {error}"
    if pipeline.record.interrupted:
        raise KeyboardInterrupt
    if pipeline.record.failure is not None:
        return {}, pipeline.record.failure
    return json.loads((folder / "metrics.json").read_text(encoding="utf-8")), None
