"""Maps on the command line: ``--mesh``, ``--save-map``, ``--load-map`` and ``--localise`` as a user calls them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from helpers.commands import assert_error_line, call_here, files_in
from helpers.long_wall import CAMERA, Slide

from v3d_torch.config.loading import load_config
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.evaluation import evaluate
from v3d_torch.mapping.map_io import load_map, save_map
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.types import Trajectory

OPTIONS = ("--segmenter", "none", "--set", "features.count=800")


def write_sequence(folder: Path, slide: Slide) -> Path:
    with TUMWriter(folder, CAMERA, slide.groundtruth) as writer:
        for frame in slide:
            writer.add(frame)
    return folder


def join_trajectories(*paths: Path) -> Trajectory:
    parts = [read_trajectory(path) for path in paths]
    return Trajectory(torch.cat([part.stamps for part in parts]), torch.cat([part.T_wc for part in parts]))


pytestmark = pytest.mark.usefixtures("no_figures")


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two overlapping recordings of a wall; the second is recorded a minute later."""
    folder = tmp_path_factory.mktemp("halves")
    later = Slide(700, 940, step=12)
    later.stamps += 60
    assert later.groundtruth is not None
    later.groundtruth.stamps[:] = later.stamps
    return write_sequence(folder / "first", Slide(600, 800, step=12)), write_sequence(folder / "second", later)


@pytest.fixture(scope="module")
def first(halves: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Results and map of the first recording, with a mesh."""
    out = tmp_path_factory.mktemp("first")
    room = out / "maps" / "room.map"
    done = call_here("--seq", halves[0], *OPTIONS, "--mesh", "--save-map", room, "--out", out / "results", cwd=out)
    assert done.exit_code == 0, done.stderr
    return out / "results", room


def test_mesh_and_map_are_written(first: tuple[Path, Path]) -> None:
    results, room = first
    assert {"map.ply", "mesh.ply", "trajectory.ply"} <= files_in(results)
    mesh = plyfile.PlyData.read(results / "mesh.ply")
    assert mesh["face"].count > 1000 and np.abs(np.asarray(mesh["vertex"]["z"]) - 2.0).max() < 0.02
    assert files_in(room.parent) == {"room.map"}
    assert "enabled: true" in (results / "config.yaml").read_text().split("mesh:")[1]


@pytest.mark.parametrize("localise", [False, True])
def test_second_recording_is_tracked_in_the_map_of_the_first(
    localise: bool, halves: tuple[Path, Path], first: tuple[Path, Path], tmp_path: Path
) -> None:
    results, room = first
    before = room.read_bytes()
    more = ("--localise",) if localise else ("--save-map", tmp_path / "grown.map")
    done = call_here("--seq", halves[1], *OPTIONS, "--load-map", room, *more, "--out", tmp_path / "out", cwd=tmp_path)
    assert done.exit_code == 0, done.stderr
    assert room.read_bytes() == before
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    known = json.loads((results / "metrics.json").read_text())["keyframes"]
    assert (metrics["tracked"], metrics["known_keyframes"]) == (metrics["frames"], known)
    assert f"{known} keyframes left" in done.stdout and metrics["warnings"] == []
    keyframes = (tmp_path / "out" / "keyframes.txt").read_text().splitlines()
    assert len(keyframes) == metrics["keyframes"] and (metrics["keyframes"] == 0) == localise
    # The trajectory is in the world frame of the first recording: one alignment fits both.
    estimate = join_trajectories(results / "trajectory.txt", tmp_path / "out" / "trajectory.txt")
    truth = join_trajectories(*(folder / "groundtruth.txt" for folder in halves))
    assert evaluate(truth, estimate, frames=len(estimate)).ate.rmse < 0.02
    # The coloured map covers both recordings.
    extent = [np.ptp(plyfile.PlyData.read(folder / "map.ply")["vertex"]["x"]) for folder in (results, tmp_path / "out")]
    assert (extent[1] > extent[0] + 0.5) != localise


def test_map_without_views_is_warned_of(halves: tuple[Path, Path], first: tuple[Path, Path], tmp_path: Path) -> None:
    """A map that was saved with `save_map` alone gives no point map."""
    stored = load_map(first[1], CAMERA, load_config(overrides=["features.count=800"]))
    save_map(tmp_path / "bare.map", stored.map)
    out = tmp_path / "out"
    done = call_here(
        "--seq", halves[1], *OPTIONS, "--load-map", tmp_path / "bare.map", "--localise", "--out", out, cwd=tmp_path
    )
    assert done.exit_code == 0, done.stderr
    warnings = json.loads((out / "metrics.json").read_text())["warnings"]
    assert any("has no views" in warning for warning in warnings) and "has no views" in (out / "run.log").read_text()


def test_a_single_keyframe_that_is_left_is_in_the_singular(tmp_path: Path) -> None:
    recording = write_sequence(tmp_path / "short", Slide(600, 640, step=20))
    for options in (("--save-map", "one.map"), ("--load-map", "one.map", "--localise")):
        done = call_here("--seq", recording, *OPTIONS, *options, "--out", "out", cwd=tmp_path)
        assert done.exit_code == 0, done.stderr
    assert " 1 keyframe left " in done.stdout


# --- mistakes of the user


def test_localise_without_map_is_rejected(halves: tuple[Path, Path], tmp_path: Path) -> None:
    done = call_here("--seq", halves[1], *OPTIONS, "--localise", cwd=tmp_path)
    assert_error_line(done, "error: --localise: needs the map of an earlier run; add --load-map FILE\n")
    assert list(tmp_path.iterdir()) == []


def test_damaged_map_file_is_rejected(halves: tuple[Path, Path], first: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "half.map").write_bytes(first[1].read_bytes()[:5000])
    done = call_here("--seq", halves[1], *OPTIONS, "--load-map", "half.map", cwd=tmp_path)
    assert_error_line(done, "half.map", "--save-map")
    assert files_in(tmp_path) == {"half.map"}


def test_map_without_keyframes_is_rejected(halves: tuple[Path, Path], tmp_path: Path) -> None:
    config = load_config(overrides=["features.count=800"])
    save_map(tmp_path / "none.map", SparseMap(config.mapping, config.features, CAMERA))
    done = call_here("--seq", halves[1], *OPTIONS, "--load-map", "none.map", cwd=tmp_path)
    assert_error_line(done, "none.map: has no keyframes")
    assert files_in(tmp_path) == {"none.map"}


def test_map_of_another_room_is_reported_after_the_results(first: tuple[Path, Path], tmp_path: Path) -> None:
    """The results are still written, with every frame lost."""
    other = write_sequence(tmp_path / "other", Slide(0, 60, step=12, seed=3))
    done = call_here("--seq", other, *OPTIONS, "--load-map", first[1], "--out", tmp_path / "out", cwd=tmp_path)
    assert_error_line(done, str(first[1]), str(tmp_path / "out"))
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["lost"] == 6


def test_unwritable_map_file_is_rejected_before_the_run(halves: tuple[Path, Path], tmp_path: Path) -> None:
    done = call_here("--seq", halves[0], *OPTIONS, "--save-map", tmp_path, "--out", tmp_path / "out", cwd=tmp_path)
    assert_error_line(done, f"{tmp_path}: cannot be written")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("seq/groundtruth.txt", "exists and is not a map"),
        ("room.ply", "would contain no point cloud, which is map.ply of the results"),
        ("out/metrics.json", "is a result of the run"),
        ("out/masks/1.png", "is a result of the run"),
        ("out/../out/run.log", "is a result of the run"),
    ],
)
def test_map_replaces_neither_files_of_the_user_nor_results(
    option: str, words: str, halves: tuple[Path, Path], tmp_path: Path
) -> None:
    (tmp_path / "seq").mkdir()
    (tmp_path / "seq" / "groundtruth.txt").write_text("measured")
    done = call_here("--seq", halves[0], *OPTIONS, "--save-map", option, "--out", "out", cwd=tmp_path)
    assert_error_line(done, f"{option}: {words}", "choose another file with --save-map")
    assert files_in(tmp_path) == {"seq/groundtruth.txt"}
    assert (tmp_path / "seq" / "groundtruth.txt").read_text() == "measured"


@pytest.mark.parametrize("option", ["--bag", "--rerun"])
def test_map_and_recording_in_one_file_are_rejected(option: str, halves: tuple[Path, Path], tmp_path: Path) -> None:
    done = call_here("--seq", halves[0], *OPTIONS, "--save-map", "a", option, tmp_path / "a", cwd=tmp_path)
    assert_error_line(done, f"--save-map a: is also the file of {option}; choose another file")
    assert files_in(tmp_path) == set()


def test_map_of_an_earlier_run_is_replaced(halves: tuple[Path, Path], first: tuple[Path, Path], tmp_path: Path) -> None:
    shutil.copy(first[1], tmp_path / "room.map")
    done = call_here(
        *("--seq", halves[1], *OPTIONS, "--load-map", "room.map", "--save-map", "room.map", "--out", "out"),
        cwd=tmp_path,
    )
    assert done.exit_code == 0, done.stderr
    assert (tmp_path / "room.map").read_bytes() != first[1].read_bytes()
