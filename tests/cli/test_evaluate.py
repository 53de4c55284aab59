"""``python -m v3d_torch evaluate`` as called by a user."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers.commands import invoke

from v3d_torch.cli.evaluate import app, main
from v3d_torch.datasets.tum_extents import EXTENTS
from v3d_torch.datasets.tum_trajectory import read_trajectory, write_trajectory
from v3d_torch.evaluation import evaluate
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    """A ground truth, and an estimate with an error of 1 cm in every ninth pose."""
    generator = torch.Generator().manual_seed(0)
    stamps = torch.arange(90, dtype=torch.float64) / 30
    T_wc = se3_exp(torch.randn(90, 6, dtype=torch.float64, generator=generator))
    write_trajectory(tmp_path / "groundtruth.txt", Trajectory(stamps, T_wc))
    T_wc = T_wc.clone()
    T_wc[::9, 0, 3] += 0.01
    write_trajectory(tmp_path / "estimate.txt", Trajectory(stamps, T_wc))
    return str(tmp_path / "groundtruth.txt"), str(tmp_path / "estimate.txt")


call = partial(invoke, app, COLUMNS="120", NO_COLOR="1")


def test_json_from_the_shell(files: tuple[str, str]) -> None:
    command = [sys.executable, "-m", "v3d_torch", "evaluate", *files, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    values = json.loads(done.stdout)
    assert values["ate"]["rmse"] == pytest.approx(0.01 * (10 / 90 * 80 / 90) ** 0.5, rel=0.02)
    assert values["rpe"]["rot"]["max"] < 1e-4 and values["coverage"] is None


def test_tables_have_coverage_units_and_the_papers_methods(files: tuple[str, str]) -> None:
    result = call(*files, "--sequence", "fr3/w/rpy", "--frames", "100")
    assert result.exit_code == 0
    assert "90 of 90 poses have ground truth, 90.0% of the frames" in result.stdout
    for words in ("ATE, m", "RPE, m/s", "RPE, deg/s", "DynaSLAM", "0.0354", "this result"):
        assert words in result.stdout


def test_sequence_is_guessed_from_path(files: tuple[str, str], tmp_path: Path) -> None:
    assert "DynaSLAM" not in call(*files).stdout
    named = tmp_path / "rgbd_dataset_freiburg3_walking_rpy.txt"
    named.write_bytes(Path(files[0]).read_bytes())
    assert "0.0354" in call(str(named), files[1]).stdout


@pytest.mark.parametrize(("count", "label"), [(827, "this result "), (60, "this result (part: 60 of 827 frames)")])
def test_part_of_a_sequence_is_marked_in_the_papers_table(count: int, label: str, tmp_path: Path) -> None:
    frames, poses, length = EXTENTS["fr3/w/xyz"]
    assert poses is not None and length is not None
    T_wc = torch.eye(4, dtype=torch.float64).repeat(poses.number, 1, 1)
    T_wc[:, 0, 3] = torch.linspace(0, length, poses.number, dtype=torch.float64)
    stamps = torch.linspace(poses.first, poses.last, poses.number, dtype=torch.float64)
    write_trajectory(tmp_path / "groundtruth.txt", Trajectory(stamps, T_wc))
    stamps = torch.linspace(frames.first, frames.last, frames.number, dtype=torch.float64)[:count]
    write_trajectory(tmp_path / "estimate.txt", Trajectory(stamps, T_wc[:count]))
    result = call(str(tmp_path / "groundtruth.txt"), str(tmp_path / "estimate.txt"), "--sequence", "fr3_w_xyz")
    assert result.exit_code == 0 and label in result.stdout


def test_unit_of_rpe_contains_other_delta(files: tuple[str, str]) -> None:
    assert "RPE, m/0.5 s" in call(*files, "--delta", "0.5").stdout


def test_poses_within_the_maximum_difference_are_compared(files: tuple[str, str]) -> None:
    for path, delay in zip(files, (0.0, 0.05), strict=True):
        poses = read_trajectory(path)
        write_trajectory(Path(path), Trajectory(poses.stamps[::6] + delay, poses.T_wc[::6]))  # 0.2 s apart
    apart = call(*files)
    assert apart.exit_code == 2 and "estimate.txt" in apart.stderr
    assert "15 of 15 poses have ground truth" in call(*files, "--max-difference", "0.06").stdout


def test_notes_are_printed(files: tuple[str, str]) -> None:
    assert "note: no two poses with ground truth are 10 s apart: no RPE" in call(*files, "--delta", "10").stdout


def test_true_poses_that_are_not_finite_are_left_out_with_a_note(files: tuple[str, str]) -> None:
    path = Path(files[0])
    first, second, *others = path.read_text().splitlines()
    path.write_text("\n".join([first, f"{second.split()[0]} {' '.join(7 * ['nan'])}", *others]))
    result = call(*files)
    assert "89 of 90 poses have ground truth" in result.stdout
    assert "note: 1 of 90 poses of the ground truth are empty or not finite and are left out" in result.stdout


@pytest.mark.parametrize("case", ["missing", "broken", "elsewhere", "sequence"])
def test_bad_input_is_one_line_and_exit_code_2(case: str, files: tuple[str, str], tmp_path: Path) -> None:
    bad = tmp_path / "bad.txt"
    arguments = [files[0], str(bad)]
    if case == "broken":
        bad.write_text("1 2 3\n")
    elif case == "elsewhere":
        T_wc = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
        write_trajectory(bad, Trajectory(torch.arange(500, 505, dtype=torch.float64), T_wc))
    elif case == "sequence":
        arguments = [*files, "--sequence", "bad.txt"]
    result = call(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("error: ") and "bad.txt" in result.stderr and result.stderr.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is always full")
@pytest.mark.parametrize("options", [(), ("--json",)])
def test_output_that_cannot_be_written_is_one_line_and_exit_code_2(
    options: tuple[str, ...], files: tuple[str, str]
) -> None:
    command = [sys.executable, "-m", "v3d_torch", "evaluate", *files, *options]
    with Path("/dev/full").open("w") as output:
        done = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, text=True)  # noqa: S603
    reason = "reading or writing failed (No space left on device); check the disk, and where the output goes"
    assert (done.returncode, done.stderr) == (2, f"error: {reason}\n")


def test_defaults_of_command_equal_those_of_function() -> None:
    command, function = (inspect.signature(f).parameters for f in (main, evaluate))
    assert command["max_difference"].default == function["max_time_difference"].default
    assert command["delta"].default == function["rpe_delta"].default
