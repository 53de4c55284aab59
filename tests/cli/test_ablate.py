"""``python -m v3d_torch ablate`` as a user calls it: all variants on a moment of the demo, errors, the tables."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from typer.testing import CliRunner, Result

from v3d_torch.batch import study
from v3d_torch.batch.study import SegmentOnce
from v3d_torch.cli.ablate import app
from v3d_torch.config import Config
from v3d_torch.config.loading import CONFIGS, load_config
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.errors import OutputError
from v3d_torch.evaluation.ablation import COLUMNS, VARIANTS, csv_text, markdown, screen_table, verdict
from v3d_torch.evaluation.outcome import Outcome
from v3d_torch.types import Instances, RGBDFrame

FRAMES = 6


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)), env={"V3D_DATA": "", "NO_COLOR": "1"})


def shell(module: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # noqa: S603
        [sys.executable, "-m", "v3d_torch", module, *map(str, arguments)],
        env=os.environ | {"NO_COLOR": "1"},
        capture_output=True,
        text=True,
        timeout=500,
    )


def assert_one_sentence(result: Result, *words: str) -> None:
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1, result.stderr
    for word in words:
        assert word in result.stderr


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "ablation.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def sequence(moment: Path) -> Path:
    return moment


@pytest.fixture(scope="module")
def done(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The whole study with one seed: its folder and what the screen showed."""
    out = tmp_path_factory.mktemp("study") / "out [a]"
    process = shell("ablate", "--seq", sequence, "--seeds", "1", "--out", out)
    assert process.returncode == 0, process.stderr
    return out, process.stdout


# --- the study


def test_blanks_after_the_commas_are_no_part_of_the_names() -> None:
    assert_one_sentence(call("--seq", "nowhere", "--variants", " baseline, full "), "nowhere: is neither")


def test_all_variants_stand_in_one_table(done: tuple[Path, str]) -> None:
    out, screen = done
    for words in ("Ablation on moment", *VARIANTS, "ATE, m", "RPE", "moving out", f"results: {out}"):
        assert words in screen
    assert "…" not in screen
    document = (out / "ablation.md").read_text(encoding="utf-8")
    rows = [line for line in document.splitlines() if line.startswith("| ")]
    assert [row.split(" | ")[0].removeprefix("| ") for row in rows[2:]] == list(VARIANTS)
    assert document.count("\n## ") == 1 and "four times" in document


def test_every_run_has_its_results_and_the_configuration_of_its_variant(done: tuple[Path, str]) -> None:
    for variant in VARIANTS:
        folder = done[0] / "moment" / variant / "seed0"
        for name in ("trajectory.txt", "metrics.json", "dynamics.parquet", "run.log", "figures/trajectory.png"):
            assert (folder / name).is_file()
        assert load_config(folder / "config.yaml") == load_config(CONFIGS[variant])


def test_the_file_of_figures_has_those_of_the_runs(done: tuple[Path, str]) -> None:
    rows = rows_of(done[0])
    assert [(row["sequence"], row["variant"], row["seed"]) for row in rows] == [("moment", v, "0") for v in VARIANTS]
    for row in rows:
        metrics = json.loads((done[0] / "moment" / row["variant"] / "seed0" / "metrics.json").read_text())
        assert row["failure"] == ""
        assert float(row["ate.rmse"]) == metrics["ate"]["rmse"]
        assert float(row["masks.moving_left_out"]) == metrics["masks"]["moving_left_out"]
        assert metrics["masks"]["frames"] == FRAMES
        assert row["rpe.trans.rmse"] == "" and metrics["rpe"] is None  # shorter than a second
    moving = {row["variant"]: float(row["masks.moving_left_out"]) for row in rows}
    assert moving["baseline"] == 0.0 and moving["full"] > 0.5


@pytest.mark.parametrize("variant", ["paper", "no_prediction"])
def test_the_results_are_those_of_the_run_command(
    variant: str, done: tuple[Path, str], sequence: Path, tmp_path: Path
) -> None:
    """The instances of ``no_prediction`` are those that were kept from the run of ``no_voting``."""
    arguments = ("--seq", sequence, "--config", CONFIGS[variant], "--out", tmp_path)
    process = shell("run", *arguments)
    assert process.returncode == 0, process.stderr
    ours = done[0] / "moment" / variant / "seed0"
    for name in ("trajectory.txt", "dynamics.parquet", "map.ply", "config.yaml"):
        assert (ours / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_every_ablation_of_the_package_is_a_variant_and_no_two_are_the_same() -> None:
    assert set(VARIANTS) | {"default"} == set(CONFIGS)
    assert len({load_config(CONFIGS[variant]).model_dump_json() for variant in VARIANTS}) == len(VARIANTS)


def test_help_is_light_and_names_the_variants() -> None:
    assert ",".join(VARIANTS) in "".join(call("--help").stdout.split())
    probe = "import sys, v3d_torch.cli.ablate; print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)  # noqa: S603
    assert result.stdout.strip() == "False"


# --- instances that are kept


def test_kept_instances_are_the_same_bit_for_bit_and_nobody_can_change_them() -> None:
    generator = torch.Generator().manual_seed(0)
    asked = []

    def segment(frame: RGBDFrame) -> Instances:
        asked.append(frame.index)
        count = frame.index  # the first frame shows nothing
        return Instances(
            torch.rand(count, 5, 13, generator=generator) > 0.5,
            torch.arange(count),
            torch.rand(count, generator=generator),
            torch.rand(count, 4, generator=generator),
        )

    given: dict[int, Instances] = {}

    def listening(frame: RGBDFrame) -> Instances:
        given[frame.index] = segment(frame)
        return given[frame.index]

    once = SegmentOnce(listening)
    frames = [RGBDFrame(k, float(k), torch.zeros(3, 5, 13, dtype=torch.uint8), torch.zeros(1, 5, 13)) for k in range(4)]
    for frame in [*frames, *reversed(frames)]:
        kept, original = once(frame), given[frame.index]
        assert kept.masks.dtype == torch.bool
        for name in ("masks", "labels", "scores", "boxes"):
            assert torch.equal(getattr(kept, name), getattr(original, name)), name
        kept.masks.fill_(True)
    assert asked == [0, 1, 2, 3]


def test_a_frame_that_is_turned_is_another_picture() -> None:
    asked = []

    def segment(frame: RGBDFrame) -> Instances:
        asked.append(frame.image.shape[1:])
        return Instances.empty(*frame.image.shape[1:])

    once = SegmentOnce(segment)
    image = torch.randint(0, 255, (3, 5, 13), generator=torch.Generator().manual_seed(0)).byte()
    for turns in (0, 1, 2, 3, 2, 1, 0):
        turned = torch.rot90(image, turns, dims=(1, 2))
        assert once(RGBDFrame(0, 0.0, turned, torch.zeros(1, *turned.shape[1:]))).masks.shape[1:] == turned.shape[1:]
    assert asked == [(5, 13), (13, 5), (5, 13), (13, 5)]


# --- what goes wrong


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--variants", "baseline,no_chamfr"), ("no_chamfr", "no_chamfer")),
        (("--set", "objects.voting.vote_treshold=3"), ("objects.voting.vote_threshold",)),
        (("--seq", "fr3/w/xzy"), ("fr3/w/xyz",)),
        (("--seq", "nowhere/at/all"), ("nowhere/at/all",)),
    ],
)
def test_bad_input_is_one_sentence_before_anything_runs(
    arguments: tuple[str, ...], words: tuple[str, ...], sequence: Path, tmp_path: Path
) -> None:
    assert_one_sentence(call("--seq", sequence, "--out", tmp_path / "out", *arguments), *words)
    assert not (tmp_path / "out").exists()


def test_two_sequences_of_one_name(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "moment").symlink_to(sequence)
    result = call("--seq", sequence, "--seq", tmp_path / "moment", "--out", tmp_path / "out")
    assert_one_sentence(result, "moment", "apart")
    assert not (tmp_path / "out").exists()


def test_a_file_where_the_results_belong(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    arguments = ("--seq", sequence, "--variants", "baseline", "--out", tmp_path / "taken" / "out")
    assert_one_sentence(call(*arguments), str(tmp_path / "taken"))


def test_no_seeds_are_refused_by_the_command_line(sequence: Path) -> None:
    assert call("--seq", sequence, "--seeds", "0").exit_code == 2


def test_a_run_that_fails_does_not_cost_the_others(sequence: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(sequence, broken)
    colour = sorted((broken / "rgb").iterdir())[3]
    colour.write_bytes(colour.read_bytes()[:1000])
    out = tmp_path / "out"
    result = call("--seq", broken, "--seq", sequence, "--variants", "baseline", "--seeds", "1", "--out", out)
    assert_one_sentence(result, "1 of 2 runs failed", "broken, baseline, seed 0", colour.name)
    rows = rows_of(out)
    assert [bool(row["failure"]) for row in rows] == [True, False]
    assert [bool(row["ate.rmse"]) for row in rows] == [False, True]  # of half a trajectory none is taken
    document = (out / "ablation.md").read_text(encoding="utf-8")
    assert f"- broken, baseline, seed 0: failed: {colour}" in document
    assert len((out / "broken" / "baseline" / "seed0" / "trajectory.txt").read_text().splitlines()) == 3


class Raising:
    """`study.track` that raises at its nth call, from 0, and does nothing but note the seeds at the others."""

    def __init__(self, error: BaseException, at: int) -> None:
        self.error, self.at, self.seeds = error, at, list[int]()

    def __call__(self, sequence: object, segment: object, config: Config, folder: Path, console: object) -> Any:
        self.seeds.append(config.seed)
        if len(self.seeds) == self.at + 1:
            raise self.error
        (folder / "metrics.json").write_text(json.dumps({"ate": {"rmse": 0.01, "std": 0.002}, "rpe": None}))
        return SimpleNamespace(run=SimpleNamespace(failure=None, interrupted=False)), None


def test_an_error_in_the_program_costs_one_run(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "track", Raising(RuntimeError("shapes differ"), at=1))
    result = call("--seq", sequence, "--variants", "baseline", "--out", tmp_path)
    assert_one_sentence(result, "1 of 3 runs failed", "RuntimeError: shapes differ")
    assert [row["failure"] for row in rows_of(tmp_path)] == ["", "RuntimeError: shapes differ", ""]


def test_a_full_disk_ends_the_study(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = Raising(OutputError("x: cannot be written (No space left); free the disk"), at=1)
    monkeypatch.setattr(study, "track", broken)
    assert_one_sentence(call("--seq", sequence, "--variants", "baseline", "--out", tmp_path), "No space left")
    assert broken.seeds == [0, 1] and len(rows_of(tmp_path)) == 1


def test_ctrl_c_ends_the_study_and_keeps_what_is_done(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within a run, whose frames until then are written too."""
    read, calls = TUMSequence.__getitem__, []

    def interrupted(self: TUMSequence, index: int) -> RGBDFrame:
        calls.append(index)
        if len(calls) == FRAMES + 5:
            raise KeyboardInterrupt
        return read(self, index)

    monkeypatch.setattr(TUMSequence, "__getitem__", interrupted)
    result = call("--seq", sequence, "--variants", "baseline", "--out", tmp_path)
    assert_one_sentence(result, "interrupted after 1 of 3 runs", str(tmp_path))
    assert len(rows_of(tmp_path)) == 1 and "## moment" in (tmp_path / "ablation.md").read_text()
    trajectory = tmp_path / "moment" / "baseline" / "seed1" / "trajectory.txt"
    assert len(trajectory.read_text().splitlines()) == 4


# --- the tables


def outcomes(ates: dict[str, list[float | None]], sequence: str = "s") -> list[Outcome]:
    """Runs with these errors; None is a run that failed."""
    return [
        Outcome(sequence, variant, seed, {}, "a | broke [x]")
        if ate is None
        else Outcome(sequence, variant, seed, {"ate": {"rmse": ate, "std": ate / 2}, "rpe": None, "masks": None})
        for variant, values in ates.items()
        for seed, ate in enumerate(values)
    ]


def test_median_range_and_the_best() -> None:
    document = markdown(outcomes({"baseline": [0.5, 0.3, 0.4], "full": [0.1, 0.1, 0.1], "paper": [None, 0.2, 0.9]}))
    lines = [line for line in document.splitlines() if line.startswith("|")]
    assert lines[0] == "| variant | ATE, m | SD, m | failed |"  # figures that nobody has are no columns
    assert lines[2] == "| baseline | 0.4000 [0.3000-0.5000] | 0.2000 [0.1500-0.2500] | 0 |"
    assert lines[3] == "| full | **0.1000** | **0.0500** | 0 |"
    assert lines[4] == "| paper | 0.5500 [0.2000-0.9000] | 0.2750 [0.1000-0.4500] | 1 |"
    assert "- s, paper, seed 0: failed: a | broke [x]" in document
    same = markdown(outcomes({"baseline": [0.10004], "full": [0.1], "paper": [0.1001]}))
    assert same.count("**0.1000**") == 2  # what the table does not show is no difference


def test_where_all_seeds_failed_there_is_a_dash() -> None:
    document = markdown(outcomes({"baseline": [None, None], "full": [0.1, 0.2]}))
    assert "| baseline | - | - | 2 |" in document
    assert "| variant | failed |\n| --- | ---: |\n| full | 2 |" in markdown(outcomes({"full": [None, None]}))


def test_leaving_nothing_out_is_not_marked_as_the_best() -> None:
    def masks(variant: str, share: float) -> Outcome:
        scores = {"moving_left_out": share, "static_left_out": share / 10, "id_changes_per_60_frames": share}
        return Outcome("s", variant, 0, {"ate": None, "rpe": None, "masks": scores})

    document = markdown([masks("baseline", 0.0), masks("full", 0.97)])
    assert "| full | 97.0% | 9.7% | 0.97 |" in document and "**" not in document
    assert "no ground truth" in str(masks("full", 0.5))


@pytest.mark.parametrize(
    ("ates", "says"),
    [
        ({"full": [0.1, 0.2, 0.3], "paper": [0.25, 0.3, 0.35]}, "No variant is better"),
        ({"full": [0.1, 0.25, 0.3], "paper": [0.05, 0.1, 0.2]}, "within noise of paper"),
        ({"full": [0.21, 0.25, 0.3], "paper": [0.05, 0.1, 0.2]}, "worse than paper: their ranges"),
        ({"full": [0.21], "paper": [0.2]}, "with one seed, the difference may be noise"),
        ({"paper": [0.01], "full": [0.01004]}, "No variant is better"),  # by less than the table shows
        ({"baseline": [0.1], "paper": [0.2]}, ""),
        ({"full": [None], "paper": [0.2]}, ""),
        ({"full": [0.1], "paper": [None]}, ""),
    ],
)
def test_the_verdict(ates: dict[str, list[float | None]], says: str) -> None:
    spoken = verdict(outcomes(ates))
    assert says in spoken and bool(says) == bool(spoken)


def test_each_sequence_has_its_own_table() -> None:
    both = [*outcomes({"full": [0.1]}, "fr3/w/xyz"), *outcomes({"full": [0.3]}, "demo [x]")]
    document = markdown(both)
    assert document.index("## fr3/w/xyz") < document.index("0.1000") < document.index("## demo [x]")
    assert "0.1000" not in document[document.index("## demo [x]") :]
    rows = list(csv.DictReader(csv_text(both).splitlines()))
    assert [row["sequence"] for row in rows] == ["fr3/w/xyz", "demo [x]"]
    assert set(COLUMNS) < rows[0].keys()


def test_brackets_on_the_screen_are_no_markup() -> None:
    from rich.console import Console

    console = Console(width=100, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    console.print(screen_table(outcomes({"full": [0.1, 0.3], "paper": [0.5, None]}, "demo [red]")))
    text = console.export_text()
    assert "Ablation on demo [red]" in text and "[0.1000-0.3000]" in text
