"""Table of the time of each stage, of records with chosen times."""

from __future__ import annotations

from io import StringIO

import torch
from rich.console import Console

from v3d_torch.pipeline.run_record import RunRecord
from v3d_torch.runs.profile_table import profile_table
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.types import RGBDFrame

STAGES = {"read": 0.005, "features": 0.02, "segmentation": 0.03, "tracking": 0.01, "bundle": 0.002}
"""Wall time of each stage in each frame, seconds; 67 ms in total."""


def printed(seconds: float) -> str:
    """Table of a run of two frames that took this time each, seconds, in one line."""
    record = RunRecord(seconds=2 * seconds)
    for number in range(2):
        frame = RGBDFrame(number, float(number), torch.zeros(3, 2, 2, dtype=torch.uint8), torch.zeros(1, 2, 2))
        record.times.append(frame, {stage: StageTime(wall, wall / 2) for stage, wall in STAGES.items()})
    text = StringIO()
    Console(file=text, width=100).print(profile_table(record))
    return " ".join(text.getvalue().split())


def test_overlapping_stages_name_the_chain_that_limits_the_rate() -> None:
    text = printed(0.04)
    assert "40.0 ms of wall time per frame, less than the sum of the stages, because stages overlap" in text
    assert "the chain that limits the rate is segmentation" in text  # not features, which another thread detects
    assert "chain: features │ 25.0" in text and "chain: segmentation │ 30.0" in text
    assert "chain: tracking │ 10.0" in text and "chain: back end │ 2.0" in text


def test_heading_of_the_fraction_names_the_time() -> None:
    assert "┃ CPU ┃ fraction of CPU ┃" in printed(0.04)


def test_time_outside_of_stages_in_turn_is_printed() -> None:
    text = printed(0.0885)
    assert "88.5 ms of wall time per frame, of which 21.5 ms outside the stages" in text
    assert "overlap" not in text and "limits" not in text
