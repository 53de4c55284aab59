"""Commands with a stage by import path, as a user calls them; files alone never have code imported."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import assert_error_line, call, call_here
from helpers.corpus.outputs import at_frame
from helpers.own_stages import MODULE, SEGMENT, write_own_stages
from helpers.tum_folder_with_person import write_walker
from PIL import Image
from typer.testing import CliRunner, Result

from v3d_torch import V3DSLAM, load_state, save_state
from v3d_torch.cli import ablate, batch, evaluate, export, report
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.errors import ConfigError

FRAMES = 5
OVERRIDES = ("--set", SEGMENT, "--set", "checkpoint.interval=0", "--set", "checkpoint.max_time_fraction=1", "--serial")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walker(tmp_path_factory.mktemp("sequences") / "seq", FRAMES)


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undrawn: None) -> Path:
    """Folder of the user's module, from which it can be imported; it is not imported yet."""
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    folder = write_own_stages(tmp_path / "own")
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
    monkeypatch.syspath_prepend(folder)
    return folder


@pytest.fixture
def interrupted(sequence: Path, own: Path, tmp_path: Path) -> Path:
    """Results of a run with the user's segmenter that was interrupted; the module is forgotten."""
    with at_frame(2, lambda: os.kill(os.getpid(), signal.SIGINT)):
        done = call_here("--seq", sequence, "--out", tmp_path / "out", *OVERRIDES, cwd=tmp_path)
    assert_error_line(done, "interrupted after")
    del sys.modules[MODULE]
    return tmp_path / "out"


def test_run_in_a_new_process_finds_the_stage_by_pythonpath(sequence: Path, tmp_path: Path) -> None:
    own = write_own_stages(tmp_path / "own")
    arguments = ("--seq", sequence, "--out", tmp_path / "out", "--save-masks", "--set", SEGMENT)
    path = os.pathsep.join([str(own), os.environ.get("PYTHONPATH", "")])
    done = call(*arguments, cwd=tmp_path, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["stages"] == {"segment": f"{MODULE}:Corner"}
    assert load_config(tmp_path / "out" / "config.yaml").stages.paths == metrics["stages"]
    masks = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "out" / "masks").iterdir())]
    assert len(masks) == FRAMES and (masks[0][:8, :8] == 255).all() and (masks[0] == 0).any()


def test_network_in_place_of_a_stage_draws_the_figures_too(sequence: Path, tmp_path: Path) -> None:
    own = write_own_stages(tmp_path / "own")
    overrides = ("--set", SEGMENT, "--set", f"stages.smooth_depth={MODULE}:Network")
    path = os.pathsep.join([str(own), os.environ.get("PYTHONPATH", "")])
    done = call("--seq", sequence, "--out", tmp_path / "out", *overrides, cwd=tmp_path, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "figures" / "clusters.png").is_file()


def test_missing_module_is_one_line_before_the_run(sequence: Path, tmp_path: Path) -> None:
    done = call_here("--seq", sequence, "--out", tmp_path / "out", "--set", "stages.odometry=no_lab:PnP", cwd=tmp_path)
    assert_error_line(done, "stages.odometry=no_lab:PnP: the module no_lab cannot be imported", "PYTHONPATH")


@pytest.mark.usefixtures("undrawn")
def test_failure_of_a_stage_is_named_and_the_log_has_its_traceback(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "failing.py").write_text(
        "class Boom:\n    def __init__(self, config, camera): pass\n    def __call__(self, frame): return 1 / 0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    stage = "stages.segment=failing:Boom"
    done = call_here("--seq", sequence, "--out", tmp_path / "out", "--set", stage, cwd=tmp_path)
    assert_error_line(done, f"error: {stage} failed with ZeroDivisionError: division by zero (the results of the 0 fra")
    assert "return 1 / 0" in (tmp_path / "out" / "run.log").read_text()


@pytest.mark.usefixtures("undrawn")
def test_stage_that_exits_ends_the_run_with_the_results_so_far(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "leaving.py").write_text(
        "from v3d_torch.geometry.depth_smoother import DepthSmoother\n"
        "class Leave(DepthSmoother):\n"
        "    calls = 0\n"
        "    def __init__(self, config, camera): super().__init__(5, 1.0, 0.05)\n"
        "    def forward(self, depth):\n"
        "        self.calls += 1\n"
        "        if self.calls == 3: raise SystemExit\n"
        "        return super().forward(depth)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    stage, out = "stages.smooth_depth=leaving:Leave", tmp_path / "out"
    done = call_here("--seq", sequence, "--out", out, "--segmenter", "none", "--set", stage, cwd=tmp_path)
    assert_error_line(done, f"error: {stage} failed with SystemExit (the results of the 2 frames before are in")
    assert (out / "metrics.json").is_file()


def test_configuration_file_gives_the_same_results(sequence: Path, own: Path, tmp_path: Path) -> None:
    (tmp_path / "lab.yaml").write_text(f"stages:\n  segment: {MODULE}:Corner\n")
    for name, option in (("a", ("--set", SEGMENT)), ("b", ("--config", tmp_path / "lab.yaml"))):
        done = call_here("--seq", sequence, "--out", tmp_path / name, *option, cwd=tmp_path)
        assert done.exit_code == 0, done.stderr
    for name in ("trajectory.txt", "objects.parquet", "config.yaml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_run_is_resumed_only_if_the_user_names_its_stages_again(
    interrupted: Path, sequence: Path, tmp_path: Path
) -> None:
    before = (interrupted / "checkpoint.v3d").read_bytes()
    for option in ((), ("--set", f"stages.smooth_depth={MODULE}:flat")):
        done = call_here("--resume", interrupted, *option, cwd=tmp_path)
        assert done.exit_code == 2 and MODULE not in sys.modules
        assert (interrupted / "checkpoint.v3d").read_bytes() == before
    assert_error_line(call_here("--resume", interrupted, cwd=tmp_path), f"its run imported code, {SEGMENT}; give --set")
    assert call_here("--resume", interrupted, "--set", SEGMENT, cwd=tmp_path).exit_code == 0
    assert call_here("--seq", sequence, "--out", tmp_path / "whole", *OVERRIDES, cwd=tmp_path).exit_code == 0
    for name in ("trajectory.txt", "objects.parquet", "map.ply"):
        assert (interrupted / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_commands_on_results_import_nothing(interrupted: Path, sequence: Path, tmp_path: Path) -> None:
    for app, arguments in (
        (report.app, [interrupted]),
        (export.app, [interrupted, "--format", "nerfstudio", "--no-masks", "--out", tmp_path / "exported"]),
        (evaluate.app, [sequence / "groundtruth.txt", interrupted / "trajectory.txt"]),
    ):
        done = CliRunner().invoke(app, list(map(str, arguments)))
        assert done.exit_code == 0, done.output
    assert MODULE not in sys.modules


def test_saved_state_imports_only_the_stages_that_are_given(sequence: Path, own: Path, tmp_path: Path) -> None:
    source, config = load_sequence(str(sequence)), load_config(overrides=[SEGMENT])
    slam = V3DSLAM(source.camera, config=config)
    slam(source[0])
    save_state(tmp_path / "slam.state", slam)
    del sys.modules[MODULE]
    with pytest.raises(ConfigError, match=rf"slam\.state: would import code, {SEGMENT}; give load_state the stages"):
        load_state(tmp_path / "slam.state")
    load_state(tmp_path / "slam.state", slam.segment)  # replaces the segmenter of the configuration
    assert MODULE not in sys.modules
    loaded = load_state(tmp_path / "slam.state", stages=config.stages)
    assert loaded(source[1]).T_wc.equal(slam(source[1]).T_wc)


def test_batch_runs_the_stage_in_its_processes(sequence: Path, own: Path, tmp_path: Path) -> None:
    (tmp_path / "lab.yaml").write_text(f"stages:\n  segment: {MODULE}:Corner\n")
    arguments = ["--seqs", sequence, "--configs", tmp_path / "lab.yaml", "--workers", "2", "--out", tmp_path / "out"]
    done = CliRunner().invoke(batch.app, list(map(str, arguments)))
    assert done.exit_code == 0, done.output
    metrics = json.loads((tmp_path / "out" / "seq" / "lab" / "seed0" / "metrics.json").read_text())
    assert metrics["stages"] == {"segment": f"{MODULE}:Corner"} and metrics["failure"] is None


def test_batch_with_a_missing_module_is_an_error_before_the_first_run(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "lab.yaml").write_text("stages:\n  mapper: lab:Mapper\n")
    arguments = ["--seqs", str(sequence), "--out", str(tmp_path / "out"), "--configs", str(tmp_path / "lab.yaml")]
    assert_error_line(CliRunner().invoke(batch.app, arguments), "unknown key stages.mapper")
    (tmp_path / "lab.yaml").write_text("stages:\n  odometry: no_lab:PnP\n  segment: json:JSONDecoder\n")
    assert_error_line(CliRunner().invoke(batch.app, arguments), "stages.odometry=no_lab:PnP: the module no_lab cannot")
    assert not (tmp_path / "out").exists()


def test_ablation_study_uses_the_configured_segmenter(sequence: Path, own: Path, tmp_path: Path) -> None:
    def study(variants: str, out: str) -> Result:
        arguments = ["--seq", sequence, "--variants", variants, "--seeds", "1", "--out", tmp_path / out]
        return CliRunner().invoke(ablate.app, [*map(str, arguments), "--set", SEGMENT])

    assert_error_line(study("full,baseline", "none"), f"segmentation.source=none: not used with {SEGMENT}")
    assert not (tmp_path / "none").exists()
    done = study("full", "out")
    assert done.exit_code == 0, done.output
    metrics = json.loads(next((tmp_path / "out").glob("*/full/seed0/metrics.json")).read_text())
    assert metrics["stages"] == {"segment": f"{MODULE}:Corner"}
