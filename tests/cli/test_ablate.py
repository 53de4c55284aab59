"""Command ``v3d-torch ablate``: all variants on six frames of the demo, errors."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.batches import plan_seeds, without_camera_and_stamps
from helpers.commands import assert_error_line, call_here, invoke

from v3d_torch.batch import ablation_study
from v3d_torch.batch.batch_record import BatchRecord
from v3d_torch.cli.ablate import app
from v3d_torch.config.loading import CONFIGS, load_config
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.errors import InputError, OutputError
from v3d_torch.evaluation.ablation import VARIANTS
from v3d_torch.pipeline import Pipeline
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.runs.request import RunRequest, read_request
from v3d_torch.runs.result_folder import lock_results
from v3d_torch.types import RGBDFrame, Trajectory
from v3d_torch.viz.trajectory_figure import save_trajectory_figure

FRAMES = 6


call = partial(invoke, app, V3D_DATA="", NO_COLOR="1", COLUMNS="80")


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "ablation.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module", autouse=True)
def only_trajectories_are_drawn() -> Iterator[None]:
    """Draw one figure of each run. All figures would take most of the time of runs of six frames."""

    def draw(folder: Path, pipeline: Pipeline, trajectory: Trajectory, _: PointMap) -> None:
        path = folder / "figures" / "trajectory.png"
        save_trajectory_figure(pipeline.sequence.groundtruth, trajectory, path, pipeline.sequence.name)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("v3d_torch.runs.results.draw_run", draw)
        yield


@pytest.fixture(scope="module")
def sequence(moment: Path) -> Path:
    return moment


@pytest.fixture(scope="module")
def done(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder and screen output of the whole study with one seed."""
    out = tmp_path_factory.mktemp("study") / "out [a]"
    result = call("--seq", sequence, "--seeds", "1", "--out", out)
    assert result.exit_code == 0, result.stderr
    return out, result.stdout


# --- the study


def test_spaces_around_variants_are_ignored() -> None:
    assert_error_line(
        call("--seq", "nowhere", "--variants", " baseline, full "), "nowhere: is not a file, a folder or the name"
    )


def test_one_table_contains_all_variants(done: tuple[Path, str]) -> None:
    out, screen = done
    for words in ("Ablation on moment", *VARIANTS, "ATE, m", "RPE", "moving out", f"results: {out}"):
        assert words in screen
    assert "…" not in screen
    document = (out / "ablation.md").read_text(encoding="utf-8")
    rows = [line for line in document.splitlines() if line.startswith("| ")]
    assert [row.split(" | ")[0].removeprefix("| ") for row in rows[2:]] == list(VARIANTS)
    assert document.count("\n## ") == 1 and "four times" in document


def test_every_run_writes_results_and_configuration_of_its_variant(done: tuple[Path, str]) -> None:
    for variant in VARIANTS:
        folder = done[0] / "moment" / variant / "seed0"
        for name in ("trajectory.txt", "metrics.json", "objects.parquet", "run.log", "figures/trajectory.png"):
            assert (folder / name).is_file()
        assert load_config(folder / "config.yaml") == load_config(CONFIGS[variant])


def test_sequence_of_a_run_is_found_again(done: tuple[Path, str], sequence: Path) -> None:
    assert read_request(done[0] / "moment" / "baseline" / "seed0").seq == str(sequence)


def test_camera_and_frame_rate_of_a_sequence_without_them(sequence: Path, tmp_path: Path) -> None:
    numbered, camera = without_camera_and_stamps(sequence, tmp_path)
    arguments = ("--seq", numbered, "--variants", "baseline", "--seeds", "1", "--out", tmp_path / "out")
    result = call(*arguments, "--camera", camera, "--fps", "25")
    assert result.exit_code == 0, result.output
    request = read_request(tmp_path / "out" / "numbered" / "baseline" / "seed0")
    assert (request.camera, request.fps) == (str(camera), 25)


def test_folder_to_which_another_study_writes_is_error(sequence: Path, tmp_path: Path) -> None:
    with lock_results(tmp_path):
        result = call("--seq", sequence, "--variants", "baseline", "--seeds", "1", "--out", tmp_path)
        assert_error_line(result, f"{tmp_path}: another run or batch is writing to this folder")
        assert [path.name for path in tmp_path.iterdir()] == [".run.lock"]


def test_csv_matches_metrics_of_runs(done: tuple[Path, str]) -> None:
    rows = rows_of(done[0])
    assert [(row["sequence"], row["variant"], row["seed"]) for row in rows] == [("moment", v, "0") for v in VARIANTS]
    for row in rows:
        metrics = json.loads((done[0] / "moment" / row["variant"] / "seed0" / "metrics.json").read_text())
        assert row["failure"] == ""
        assert float(row["ate.rmse"]) == metrics["ate"]["rmse"]
        assert float(row["masks.moving_masked"]) == metrics["masks"]["moving_masked"]
        assert metrics["masks"]["frames"] == FRAMES
        assert row["rpe.trans.rmse"] == "" and metrics["rpe"] is None  # shorter than a second
    moving = {row["variant"]: float(row["masks.moving_masked"]) for row in rows}
    assert moving["baseline"] == 0.0 and moving["full"] > 0.5


@pytest.mark.parametrize("variant", ["paper", "no_prediction"])
def test_results_are_identical_to_run_command(
    variant: str, done: tuple[Path, str], sequence: Path, tmp_path: Path
) -> None:
    """The instances of ``no_prediction`` come from the cache that ``no_voting`` filled."""
    call_here("--seq", sequence, "--config", CONFIGS[variant], "--out", tmp_path, cwd=tmp_path)
    ours = done[0] / "moment" / variant / "seed0"
    for name in ("trajectory.txt", "objects.parquet", "map.ply", "config.yaml"):
        assert (ours / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_every_ablation_config_is_a_variant_and_all_differ() -> None:
    assert set(VARIANTS) | {"realtime"} == set(CONFIGS)
    assert len({load_config(CONFIGS[variant]).model_dump_json() for variant in VARIANTS}) == len(VARIANTS)


def test_help_lists_variants() -> None:
    assert ",".join(VARIANTS) in "".join(call("--help").stdout.split())


# --- errors


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--variants", "baseline,no_chamfr"), ("no_chamfr", "no_chamfer")),
        (("--set", "objects.voting.vote_treshold=3"), ("objects.voting.vote_threshold",)),
        (("--set", "seed=5"), ("seed=5", "--seeds")),
        (
            ("--variants", "full,no_voting", "--set", "objects.voting.enabled=true"),
            ("--set objects.voting.enabled=true: full and no_voting are then the same; remove one of them",),
        ),
        (("--set", "mapping.enabled=false"), ("mapping.enabled=false", "only `run` takes one")),
        (("--set", "segmentation.source=masks"), ("segmentation.source=masks", "only `run` takes one")),
        (("--seq", "fr3/w/xzy"), ("fr3/w/xyz",)),
        (("--seq", "nowhere/at/all"), ("nowhere/at/all",)),
    ],
)
def test_bad_input_is_one_line_before_first_run(
    arguments: tuple[str, ...], words: tuple[str, ...], sequence: Path, tmp_path: Path
) -> None:
    assert_error_line(call("--seq", sequence, "--out", tmp_path / "out", *arguments), *words)
    assert not (tmp_path / "out").exists()


def test_sequences_with_same_name_are_rejected(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "moment").symlink_to(sequence)
    result = call("--seq", sequence, "--seq", tmp_path / "moment", "--out", tmp_path / "out")
    assert_error_line(result, f"moment: {sequence} has the same name, moment", "run them separately")
    assert not (tmp_path / "out").exists()


def test_file_in_place_of_result_folder_is_error(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    arguments = ("--seq", sequence, "--variants", "baseline", "--out", tmp_path / "taken" / "out")
    assert_error_line(call(*arguments), str(tmp_path / "taken"))


def test_folder_of_an_earlier_study_is_an_error(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = FakeRuns(RuntimeError(), at=99)
    monkeypatch.setattr(ablation_study, "Run", runs)
    monkeypatch.chdir(tmp_path)
    arguments = ("--seq", sequence, "--seeds", "1", "--variants")
    assert call(*arguments, "baseline", "--out", "out").exit_code == 0
    tables = {path: path.read_bytes() for path in Path("out").glob("ablation.*")}
    result = call(*arguments, "full", "--out", "out")
    assert_error_line(result, "out: contains an earlier study; choose another folder with --out")
    assert {path: path.read_bytes() for path in Path("out").glob("ablation.*")} == tables and len(runs.seeds) == 1
    for count in (2, 3):  # without --out, each study has a folder of its own
        assert call(*arguments, "baseline").exit_code == 0
        assert len(runs.seeds) == count


def test_folder_of_a_batch_is_an_error(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of a batch have the same folders as those of a study, and would be replaced."""
    runs = FakeRuns(RuntimeError(), at=99)
    monkeypatch.setattr(ablation_study, "Run", runs)
    BatchRecord(plan_seeds(sequence, tmp_path, seeds=1), tmp_path).write()
    result = call("--seq", sequence, "--variants", "baseline", "--seeds", "1", "--out", tmp_path)
    assert_error_line(result, f"{tmp_path}: contains a batch; choose another folder with --out")
    assert not runs.seeds


def test_zero_seeds_are_rejected(sequence: Path) -> None:
    assert call("--seq", sequence, "--seeds", "0").exit_code == 2


def test_failed_run_is_reported_and_others_finish(sequence: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(sequence, broken)
    colour = sorted((broken / "rgb").iterdir())[3]
    colour.write_bytes(colour.read_bytes()[:1000])
    out = tmp_path / "out"
    result = call("--seq", broken, "--seq", sequence, "--variants", "baseline", "--seeds", "1", "--out", out)
    assert_error_line(result, "1 of 2 runs failed", "broken, baseline, seed 0", colour.name)
    rows = rows_of(out)
    assert [bool(row["failure"]) for row in rows] == [True, False]
    assert [bool(row["ate.rmse"]) for row in rows] == [False, True]  # a failed run has no score
    document = (out / "ablation.md").read_text(encoding="utf-8")
    assert f"- broken, baseline, seed 0: failed: {colour}" in document
    assert len((out / "broken" / "baseline" / "seed0" / "trajectory.txt").read_text().splitlines()) == 3


class FakeRuns:
    """Replacement of `ablation_study.Run` that stores the seeds of its runs; one run raises an error."""

    def __init__(self, error: BaseException, at: int) -> None:
        self.error, self.at, self.seeds = error, at, list[int]()

    def __call__(
        self, request: RunRequest, sequence: Any, segment: Any, folder: Path, *, save_checkpoints: bool
    ) -> Any:
        assert not save_checkpoints
        return FakeRun(self, request.config.seed, sequence, folder)


class FakeRun:
    """Run without tracking, which writes an ATE or raises the error of `FakeRuns`."""

    def __init__(self, runs: FakeRuns, seed: int, sequence: Any, folder: Path) -> None:
        self._runs, self._seed, self._folder = runs, seed, folder
        self.pipeline = SimpleNamespace(sequence=sequence, record=SimpleNamespace(failure=None, interrupted=False))

    def __call__(self, on_frame: object) -> None:
        self._runs.seeds.append(self._seed)
        if len(self._runs.seeds) == self._runs.at + 1:
            raise self._runs.error
        (self._folder / "metrics.json").write_text(json.dumps({"ate": {"rmse": 0.01, "std": 0.002}, "rpe": None}))


@pytest.mark.parametrize(
    ("error", "failure"),
    [
        (RuntimeError("shapes\ndiffer"), "RuntimeError: shapes differ"),
        (RuntimeError(), "RuntimeError"),
        (InputError("x: is damaged; copy it again"), "x: is damaged; copy it again"),
    ],
    ids=["two lines", "no message", "of the input"],
)
def test_error_fails_only_its_run(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, failure: str
) -> None:
    monkeypatch.setattr(ablation_study, "Run", FakeRuns(error, at=1))
    result = call("--seq", sequence, "--variants", "baseline", "--out", tmp_path)
    assert_error_line(result, "1 of 3 runs failed", failure)
    assert [row["failure"] for row in rows_of(tmp_path)] == ["", failure, ""]


def test_full_disk_ends_the_study(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = FakeRuns(OutputError("x: cannot be written (No space left); free the disk"), at=1)
    monkeypatch.setattr(ablation_study, "Run", broken)
    assert_error_line(call("--seq", sequence, "--variants", "baseline", "--out", tmp_path), "No space left")
    assert broken.seeds == [0, 1] and len(rows_of(tmp_path)) == 1


def test_ctrl_c_ends_study_and_keeps_results(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second run is interrupted; its frames until then are written."""
    read, calls = TUMSequence.__getitem__, []

    def interrupted(self: TUMSequence, index: int) -> RGBDFrame:
        calls.append(index)
        if len(calls) == FRAMES + 5:
            raise KeyboardInterrupt
        return read(self, index)

    monkeypatch.setattr(TUMSequence, "__getitem__", interrupted)
    result = call("--seq", sequence, "--variants", "baseline", "--out", tmp_path)
    assert_error_line(result, "interrupted after 1 of 3 runs", str(tmp_path))
    assert len(rows_of(tmp_path)) == 1 and "## moment" in (tmp_path / "ablation.md").read_text()
    trajectory = tmp_path / "moment" / "baseline" / "seed1" / "trajectory.txt"
    assert len(trajectory.read_text().splitlines()) == 4
