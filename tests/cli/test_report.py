"""``python -m v3d_torch report`` as called by a user: one self-contained page, also from incomplete results."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch
from helpers.commands import invoke
from helpers.short_wall import FRAMES, Wall, square
from helpers.square_segmenter import squares
from torch import Tensor

from v3d_torch.cli.report import app
from v3d_torch.config.loading import load_config
from v3d_torch.errors import InputError
from v3d_torch.io.files import write_text
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.report_page import render_page
from v3d_torch.runs.results import write_results
from v3d_torch.runs.stored_run import read_run
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame

VOID = {"meta", "link", "img", "br", "hr", "input"}
OPTIONAL = {"tr", "td", "th", "p", "li"}  # their end tags are optional in HTML


class Page(HTMLParser):
    """Parsed page: its text and its URLs. The constructor checks that it is well formed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text = ""
        self.urls: list[str] = []
        self.images = 0
        self._open: list[str] = []
        self.feed(html)
        assert [tag for tag in self._open if tag not in OPTIONAL] == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.urls += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "xlink:href")]
        self.images += tag == "img"
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        while self._open[-1] in OPTIONAL and self._open[-1] != tag:
            self._open.pop()
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] not in ("style", "script"):
            self.text += data + " "


def run_into(folder: Path, sequence: Wall, segment: Callable[[RGBDFrame], Instances], *overrides: str) -> None:
    config = load_config(overrides=["mapping.max_keyframe_interval=5", *overrides])
    pipeline = Pipeline(sequence, V3DSLAM(sequence.camera, segment, config), folder / "masks")
    pipeline()
    pipeline.flush()
    write_results(folder, pipeline)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a run without the free-space check over three objects, with saved masks."""
    folder = tmp_path_factory.mktemp("results")
    run_into(folder, Wall(), squares, "objects.free_space.enabled=false")
    return folder


@pytest.fixture(scope="module")
def reported(results: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """Copy of the results with a page that the command has written, and the output of the command."""
    folder = shutil.copytree(results, tmp_path_factory.mktemp("reported") / "copy <b>&")
    return folder, call(folder)


@pytest.fixture
def copy(results: Path, tmp_path: Path) -> Path:
    return shutil.copytree(results, tmp_path / "copy <b>&")


@pytest.fixture
def without_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without plots, for tests of texts and errors: plots take two seconds a page."""
    monkeypatch.setattr("v3d_torch.runs.report_page.embed_svg", lambda figure, name: "")


def call(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "v3d_torch", "report", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)  # noqa: S603


call_here = partial(invoke, app)


def page_of(folder: Path, groundtruth: Path | None = None) -> Page:
    return Page(render_page(read_run(folder, groundtruth)))


# --- a page


def test_command_writes_one_self_contained_page(reported: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    folder, done = reported
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"report: {folder / 'report.html'}\n"
    html = (folder / "report.html").read_text(encoding="utf-8")
    page = Page(html)
    assert html.startswith("<!doctype html>")
    assert all(url.startswith(("data:image/", "#")) for url in page.urls), page.urls
    assert "<script" not in html and "@import" not in html and "<link" not in html
    assert not re.search(r"url\((?!#)", html)
    assert page.images == 4  # masks, objects, votes, clusters
    frame, clouds = page.text.index("Frame with the most votes"), page.text.index("objects in the frame with the most")
    assert frame < clouds < page.text.index("The room from above")
    assert "copy <b>& " in page.text  # escaped, so not parsed as markup
    metrics = json.loads((folder / "metrics.json").read_text())
    for number in (f"{metrics['ate']['rmse']:.4f} m", f"{metrics['rpe']['trans']['rmse']:.4f} m/s", f"{FRAMES} of"):
        assert number in page.text
    for words in (
        "person 1",
        "chair 2",
        "tv 3",
        "segmentation",
        "objects.free_space.enabled",
        "left out of tracking",
        "torch",
    ):
        assert words in page.text
    # Only values that differ from the default are listed.
    assert "mapping.max_keyframe_interval" in page.text and "features.count" not in page.text
    assert "prefers-color-scheme: dark" in html and "@media print" in html


@pytest.mark.usefixtures("without_plots")
def test_page_has_name_of_resolved_folder(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "latest").symlink_to(copy.name)
    monkeypatch.chdir(copy)
    for folder in (Path(), tmp_path / "latest"):
        assert "A run of V3D-SLAM, copy <b>&" in page_of(folder).text


def test_plots_are_valid_svg_and_reproducible(reported: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    html = (reported[0] / "report.html").read_text(encoding="utf-8")
    plots = re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)
    assert len(plots) == 8  # trajectory, positions, errors, statuses, masks, objects, stage bars, stages over time
    for plot in plots:
        ET.fromstring(plot)  # noqa: S314
    references, ids = set(re.findall(r'href="#([^"]+)"', html)), set(re.findall(r' id="([^"]+)"', html))
    assert references <= ids
    assert render_page(read_run(reported[0])) == html  # of another process


def test_errors_equal_those_of_the_run(results: Path) -> None:
    evaluation = read_run(results).evaluation
    metrics = json.loads((results / "metrics.json").read_text())
    assert evaluation is not None and evaluation.rpe is not None
    assert evaluation.ate.rmse == pytest.approx(metrics["ate"]["rmse"], abs=1e-7)
    assert evaluation.rpe.rot.rmse == pytest.approx(metrics["rpe"]["rot"]["rmse"], abs=1e-5)
    assert evaluation.coverage == 1.0


def test_help_names_the_options() -> None:
    assert "--groundtruth" in call_here("--help").stdout


# --- incomplete results


@pytest.mark.usefixtures("undrawn", "without_plots")
def test_page_reports_run_that_ended_early(tmp_path: Path) -> None:
    for broken, poses in ((0, 0), (1, 1), (6, 6)):
        run_into(tmp_path / str(broken), Wall(broken=broken), square)
        page = page_of(tmp_path / str(broken))
        assert f"ended early, after {poses} of {FRAMES} frames: rgb/x.png: is truncated" in " ".join(page.text.split())
        assert ("There are no poses" in page.text) == (poses == 0)
        assert ("ATE RMSE" in page.text) == (poses >= 3)


@pytest.mark.parametrize(
    ("missing", "texts", "images"),
    [
        (
            ["objects.parquet", "groundtruth.txt"],
            ["not known: objects.parquet is missing", "There is no ground truth"],
            4,
        ),
        (["frames.parquet", "config.yaml", "keyframes.txt"], ["There is no config.yaml", "0 keyframes"], 4),
        (["trajectory.txt", "figures"], ["trajectory.txt is missing", "person 1"], 0),
    ],
)
def test_missing_file_is_reported_and_the_rest_is_shown(
    copy: Path, missing: list[str], texts: list[str], images: int
) -> None:
    for name in missing:
        (shutil.rmtree if (copy / name).is_dir() else os.unlink)(copy / name)
    page = page_of(copy)
    assert all(text in page.text for text in [*texts, "Objects", "Mean time of each stage", "Versions"])
    assert page.images == images


@pytest.mark.usefixtures("without_plots")
@pytest.mark.parametrize(
    ("moving", "static", "expected"),
    [
        (0.5, 0.25, "50.0 % of the moving and 25.0 % of the static pixels"),
        (None, 0.25, "25.0 % of the static pixels"),
        (0.5, None, "50.0 % of the moving pixels"),
    ],
)
def test_masked_percentages_are_shown_as_far_as_measured(
    copy: Path, moving: float | None, static: float | None, expected: str
) -> None:
    metrics = json.loads((copy / "metrics.json").read_text())
    metrics["masks"] = {"moving_masked": moving, "static_masked": static}
    write_text(copy / "metrics.json", json.dumps(metrics))
    assert f"Compared with the ground-truth masks, {expected} were left out of tracking." in page_of(copy).text


@pytest.mark.usefixtures("without_plots")
def test_frames_that_were_not_tracked_are_counted_by_status(copy: Path) -> None:
    metrics = json.loads((copy / "metrics.json").read_text())
    count = len(metrics["status"])
    assert "frames lost" not in " ".join(page_of(copy).text.split())
    metrics["status"][-3:] = ["odometry", "lost", "lost"]
    write_text(copy / "metrics.json", json.dumps(metrics))
    text = " ".join(page_of(copy).text.split())
    assert f"{count - 3} frames tracked 1 frames by odometry 2 frames lost" in text and "disconnected" not in text


@pytest.mark.usefixtures("without_plots")
def test_warnings_of_the_run_are_shown(copy: Path) -> None:
    metrics = json.loads((copy / "metrics.json").read_text())
    assert "Warning" not in page_of(copy).text
    metrics["warnings"] = ["the depth scale fits badly: use <5000>", "the colours are swapped"]
    write_text(copy / "metrics.json", json.dumps(metrics))
    text = page_of(copy).text
    assert all(f"Warning: {warning}" in text for warning in metrics["warnings"])


@pytest.mark.usefixtures("without_plots")
def test_latency_and_dropped_frames_of_a_live_run_are_shown(copy: Path) -> None:
    metrics = json.loads((copy / "metrics.json").read_text())
    assert "Latency" not in page_of(copy).text
    metrics["pose_latency"] = {"median": 0.0212, "p95": 0.04, "max": 0.1}
    metrics["latency"] = {"median": 0.05, "p95": 0.09, "max": 0.2}
    metrics |= {"dropped": 7, "rejected": 2, "frames": 90, "keyframes": 1, "loops": 1}
    write_text(copy / "metrics.json", json.dumps(metrics))
    text = " ".join(page_of(copy).text.split())
    assert "Latency of poses: median 21.2 ms, 95 % below 40.0 ms. Latency of results: median 50.0 ms" in text
    assert "Dropped: 7 of 90 frames, 2 late or out of order." in text
    assert "1 keyframe 1 loop closed" in text


@pytest.mark.usefixtures("without_plots")
@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (0.5, "50.0 ms of wall time per frame, less than the sum of the stages, because stages overlap."),
        (1.5, "150.0 ms of wall time per frame, of which 50.0 ms outside the stages."),
    ],
)
def test_wall_time_is_compared_with_the_sum_of_the_stages(copy: Path, seconds: float, expected: str) -> None:
    metrics = json.loads((copy / "metrics.json").read_text())
    metrics |= {"processed": 10, "seconds": seconds, "seconds_per_stage": {"read": 0.25, "tracking": 0.75}}
    write_text(copy / "metrics.json", json.dumps(metrics))
    text = " ".join(page_of(copy).text.split())
    assert expected in text and "total, s percentage of wall time" in text
    assert "wall time of all stages" in text and "0.25 25.0 %" in text  # also if the run took half a second


@pytest.mark.usefixtures("without_plots")
def test_page_of_run_without_objects(tmp_path: Path) -> None:
    run_into(tmp_path, Wall(broken=4), lambda _: Instances.empty(240, 320), "segmentation.source=none")
    page = page_of(tmp_path)
    assert "No object was detected in any frame" in page.text
    assert page.images == 1


@pytest.mark.usefixtures("without_plots")
def test_ground_truth_from_other_file_is_used(copy: Path, tmp_path: Path) -> None:
    (copy / "groundtruth.txt").rename(tmp_path / "truth.txt")
    assert read_run(copy).evaluation is None
    assert "ATE RMSE" in page_of(copy, tmp_path / "truth.txt").text


# --- errors


def test_missing_results_and_unusable_ground_truth_are_one_line_each(copy: Path, tmp_path: Path) -> None:
    write_text(tmp_path / "late.txt", "9000.0 0 0 0 0 0 0 1\n9000.1 0 0 0 0 0 0 1\n")
    for arguments, words in (
        ([tmp_path / "nowhere"], "nowhere: is not a folder"),
        ([tmp_path / (300 * "x")], "cannot be used (File name too long); check path and permissions"),
        ([copy, "--groundtruth", tmp_path / "late.txt"], "late.txt: only 0 of 14 poses"),
    ):
        done = call_here(*arguments)
        assert done.exit_code == 2 and done.stdout == ""
        assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1 and words in done.stderr
    assert not (copy / "report.html").exists()


def without(path: Path, key: str) -> None:
    metrics = json.loads(path.read_text())
    del metrics[key]
    path.write_text(json.dumps(metrics))


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_folder_above_runs_is_an_error_that_suggests_the_newest(tmp_path: Path) -> None:
    names = ("demo/2026-01-01", "demo/2026-01-02", "study/desk/full/seed0")
    for age, name in enumerate(names):
        write_text(tmp_path / name / "metrics.json", "{}")
        os.utime(tmp_path / name / "metrics.json", ns=(0, 10**9 * (10 - age)))
    for parent, newest in (("", "demo/2026-01-01"), ("demo", "demo/2026-01-01"), ("study", "study/desk/full/seed0")):
        with pytest.raises(InputError, match=re.escape(f"; pass the newest run in it, {tmp_path / newest}")):
            read_run(tmp_path / parent)
    (tmp_path / "demo/latest").symlink_to("2026-01-01")
    with pytest.raises(InputError, match=r"in it, .*latest$"):
        read_run(tmp_path / "demo")


def test_file_of_a_run_is_an_error_that_suggests_its_folder(copy: Path) -> None:
    with pytest.raises(InputError, match=re.escape(f"; pass its folder, {copy}")):
        read_run(copy / "map.ply")


def shift_stamps(path: Path, seconds: float) -> None:
    table = pq.read_table(path)
    stamps = [stamp + seconds for stamp in table["stamp"].to_pylist()]
    pq.write_table(table.set_column(table.column_names.index("stamp"), "stamp", [stamps]), path)


def drop_row(path: Path) -> None:
    pq.write_table(pq.read_table(path)[1:], path)


def with_frames(path: Path, count: int) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), "frames": count}))


@pytest.mark.usefixtures("without_plots")
@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("metrics.json", halve, r"metrics\.json: is not JSON"),
        ("metrics.json", lambda path: without(path, "status"), r"metrics\.json: status: field required"),
        ("metrics.json", lambda path: path.write_text("[]"), r"metrics\.json: the document: input should be"),
        ("trajectory.txt", lambda path: path.write_text("1 2 3\n"), r"trajectory\.txt: line 1"),
        ("trajectory.txt", lambda path: path.write_text("1 0 0 0 0 0 0 1\n"), "belong to different runs"),
        ("objects.parquet", halve, r"objects\.parquet: is not a parquet table"),
        ("objects.parquet", lambda path: shift_stamps(path, 0.05), r"objects\.parquet and .* different runs"),
        ("frames.parquet", lambda path: shift_stamps(path, 0.05), r"frames\.parquet and .* different runs"),
        ("frames.parquet", lambda path: drop_row(path), r"frames\.parquet and .* different runs"),
        ("metrics.json", lambda path: with_frames(path, -5), r"metrics\.json: frames: input should be greater"),
        (
            "frames.parquet",
            lambda path: pq.write_table(pq.read_table(path).drop(["stamp"]), path),
            "has no columns stamp",
        ),
        ("figures/masks.png", halve, r"masks\.png: is truncated or not an image"),
        ("masks/0.100000.png", lambda path: path.write_bytes(b"x"), r"0\.100000\.png: is truncated or not an image"),
    ],
)
def test_damaged_file_is_an_error_with_its_path(
    copy: Path, name: str, damage: Callable[[Path], object], message: str
) -> None:
    damage(copy / name)
    with pytest.raises(InputError, match=message):
        render_page(read_run(copy))


@pytest.mark.usefixtures("without_plots")
def test_configuration_of_other_version_is_shown_but_not_compared(copy: Path) -> None:
    write_text(copy / "config.yaml", "seed: 3\nno_longer_there: true\n")
    page = page_of(copy)
    assert "cannot be compared" in page.text and "no_longer_there: true" in page.text


def test_objects_with_other_timestamps_than_frames_are_drawn(copy: Path) -> None:
    """Tables of two runs in one folder: objects are drawn at their own timestamps."""
    table = pq.read_table(copy / "objects.parquet")
    stamps: Tensor = torch.tensor(table.column("stamp").to_pylist(), dtype=torch.float64) + 0.05
    late = table.set_column(1, "stamp", [stamps.tolist()])
    assert "person 1" in Page(render_page(replace(read_run(copy), objects=late))).text
