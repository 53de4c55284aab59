"""Runs of a calibration, and table and file of a calibrated camera."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path
from unittest.mock import MagicMock, Mock

import pytest
from helpers.box_room import CAMERA
from rich.console import Console

from v3d_torch.calibration.camera_calibration import Calibration
from v3d_torch.calibration.selection import Estimate
from v3d_torch.config import Config
from v3d_torch.datasets.cameras import load_camera
from v3d_torch.io.files import write_text
from v3d_torch.runs import calibration_run
from v3d_torch.runs.calibration_report import UNITS, calibration_table, calibration_text
from v3d_torch.runs.calibration_run import _is_converged, calibrate_sequence


def calibrated(*estimates: Estimate) -> Calibration:
    return Calibration(CAMERA, CAMERA, estimates)


@pytest.mark.parametrize(
    ("value", "sigma", "expected"),
    [
        (529.874, 10.2, "530 +- 10"),
        (4983.0, 99.6, "4980 +- 100"),
        (4983.0, 104.0, "4980 +- 100"),
        (123456789.0, 5e6, "123500000 +- 5000000"),
        (0.26234, 0.0123, "0.262 +- 0.012"),
        (-0.00004, 0.00101, "0.0000 +- 0.0010"),
        (1.23456, 0.0, "1.23456 +- 0"),
    ],
)
def test_value_is_rounded_to_the_second_digit_of_its_deviation(value: float, sigma: float, expected: str) -> None:
    calibration = calibrated(Estimate("fx", 525.0, value, sigma, accepted=True, reason=""))
    assert f"  # {expected}, given 525\n" in calibration_text(calibration, "desk")
    console = Console(width=80, file=StringIO(), record=True)
    console.print(calibration_table(calibration))
    row = next(line for line in console.export_text().splitlines() if "fx, pixels" in line)
    assert [cell.strip() for cell in row.split("│")[3:5]] == expected.split(" +- ")


@pytest.mark.parametrize("name", ["two\nlines", "not UTF-8 \udcff"])
def test_file_of_a_sequence_with_any_name_can_be_read(tmp_path: Path, name: str) -> None:
    write_text(tmp_path / "camera.yaml", calibration_text(calibrated(), name))
    assert load_camera(tmp_path / "camera.yaml") == CAMERA


def test_names_of_parameters_are_not_broken_at_80_columns() -> None:
    reason = "not significantly different from the given value"
    estimates = [Estimate(name, 0.0, -0.012345, 0.0123, accepted=False, reason=reason) for name in UNITS]
    console = Console(width=80, file=StringIO(), record=True)
    console.print(calibration_table(calibrated(*estimates)))
    text = console.export_text()
    assert all(unit.format(name) in text for name, unit in UNITS.items())


@pytest.mark.parametrize(("change", "converged"), [(0.0, True), (-4.9, True), (5.1, False), (-15.0, False)])
def test_runs_are_converged_if_no_estimate_changes_by_more_than_half_its_deviation(
    change: float, converged: bool
) -> None:
    before, after = (
        calibrated(
            Estimate("fx", 525.0, fx, 10.0, accepted=True, reason=""),
            Estimate("cx", 320.0, cx, 1.0, accepted=False, reason="not determined by the recording"),
        )
        for fx, cx in ((530.0, 300.0), (530.0 + change, 340.0))
    )
    assert _is_converged(after, CAMERA, before) is converged
    assert not _is_converged(after, CAMERA, None) and not _is_converged(calibrated(), CAMERA, before)


def test_sequence_is_opened_again_for_each_run_but_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """No run converges."""
    pipeline = Mock(return_value=Mock(failure=None))
    stubs = {"Pipeline": Mock(return_value=pipeline), "make_system": Mock(), "calibrate_camera": Mock()}
    for name, stub in {**stubs, "_is_converged": Mock(return_value=False)}.items():
        monkeypatch.setattr(calibration_run, name, stub)
    reopen, on_run = MagicMock(), Mock()
    calibrate_sequence(MagicMock(), reopen, Mock(), Config(), on_run)
    assert on_run.call_count == 4 and reopen.call_count == 3


def test_runs_are_not_converged_if_other_focal_lengths_explain_the_images_better() -> None:
    same = calibrated()
    assert _is_converged(same, CAMERA, same)
    assert not _is_converged(replace(same, next_camera=replace(CAMERA, fx=CAMERA.fx + 1)), CAMERA, same)
