"""Result files of a run."""

from __future__ import annotations

import importlib.metadata
import json
import math
import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import plyfile
import pyarrow.parquet as pq
import pytest
import torch
from helpers.short_wall import CAMERA, FRAMES, WALL, Wall, run_along_wall
from scipy.spatial.transform import Rotation

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import OutputError
from v3d_torch.evaluation import evaluate
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.occupancy.occupancy_io import load_occupancy
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.pipeline import Pipeline, RunRecord
from v3d_torch.runs import results as results_module
from v3d_torch.runs.metrics_file import read_metrics
from v3d_torch.runs.results import prepare_intermediate_results, write_results
from v3d_torch.runs.run import describe_readout
from v3d_torch.runs.state_table import make_state_table
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.types import TrackingStatus


@pytest.fixture(scope="module")
def run() -> Pipeline:
    """Complete run along the wall, with a keyframe every 5 frames."""
    return run_along_wall()


@pytest.fixture(scope="module")
def results(run: Pipeline, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "new" / "folder"
    run.flush()
    write_results(folder, run)
    return folder


def test_all_documented_files_are_written(results: Path) -> None:
    names = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file()}
    assert names == {
        *("trajectory.txt", "keyframes.txt", "groundtruth.txt", "config.yaml", "metrics.json"),
        *("frames.parquet", "states.parquet", "objects.parquet", "map.ply", "trajectory.ply"),
        *(
            "figures/trajectory.png",
            "figures/masks.png",
            "figures/objects.png",
            "figures/clusters.png",
        ),  # a single object has no votes
    }


def test_trajectory_file_has_all_frames(results: Path, run: Pipeline) -> None:
    written = read_trajectory(results / "trajectory.txt")
    torch.testing.assert_close(written.T_wc, run.slam.poses.trajectory().T_wc, rtol=0, atol=1e-8)
    assert torch.equal(written.stamps, run.sequence.stamps)
    keyframes = read_trajectory(results / "keyframes.txt")
    rows = torch.searchsorted(written.stamps, keyframes.stamps)
    assert rows.tolist() == [keyframe.frame for keyframe in run.slam.map.keyframes]
    assert rows.tolist()[:2] == [0, 5]
    torch.testing.assert_close(keyframes.T_wc, written.T_wc[rows], rtol=0, atol=1e-8)


def test_config_file_is_that_of_the_run(results: Path, run: Pipeline) -> None:
    assert load_config(results / "config.yaml") == run.slam.config
    assert load_config(results / "config.yaml").mapping.max_keyframe_interval == 5


def test_metrics_have_the_documented_keys(results: Path, run: Pipeline) -> None:
    metrics = json.loads((results / "metrics.json").read_text())
    for score in (metrics["ate"], metrics["rpe"]["trans"], metrics["rpe"]["rot"]):
        assert {"rmse", "mean", "median", "std", "max"} <= score.keys()
        assert 0 <= score["mean"] <= score["rmse"] <= score["max"] + 1e-12
    assert metrics["ate"]["rmse"] < 0.01
    assert metrics["tracked"] == metrics["frames"] == metrics["processed"] == FRAMES
    assert metrics["lost"] == metrics["odometry"] == metrics["disconnected"] == metrics["loops"] == 0
    assert metrics["coverage"] == 1.0
    assert metrics["keyframes"] == len(run.slam.map.keyframes) >= 3
    assert metrics["fps"] == pytest.approx(FRAMES / metrics["seconds"])
    assert 50 < metrics["peak_memory_mb"] < 20_000
    assert metrics["seed"] == 0 and metrics["versions"]["torch"] == importlib.metadata.version("torch")
    assert max(metrics["seconds_per_stage"].values()) <= metrics["seconds"]  # stages overlap


@pytest.mark.skipif(sys.platform != "linux", reason="reads the memory from /proc")
def test_peak_memory_is_in_millions_of_bytes() -> None:
    peak = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    assert peak is not None
    assert results_module._peak_memory_mb() == pytest.approx(1024 * int(peak[1]) / 1e6, rel=0.01)


def test_library_of_another_distribution_has_no_version(
    run: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with onnxruntime-gpu instead of onnxruntime."""

    def version_of(distribution: str) -> str:
        return importlib.metadata.version("absent" if distribution == "onnxruntime" else distribution)

    monkeypatch.setattr(results_module, "version", version_of)
    monkeypatch.setattr(results_module, "_versions", results_module._versions.__wrapped__)
    prepare_intermediate_results(tmp_path, run)()
    versions = read_metrics(tmp_path / "metrics.json").versions
    assert versions["onnxruntime"] is None and versions["torch"] == importlib.metadata.version("torch")


def test_frame_table_has_status_keyframe_and_stage_times(results: Path, run: Pipeline) -> None:
    table = pq.read_table(results / "frames.parquet").to_pandas()
    assert table["frame"].tolist() == list(range(FRAMES))
    assert np.allclose(table["stamp"], run.sequence.stamps.numpy())
    assert set(table["status"]) == {"tracked"}
    assert table["frame"][table["keyframe"]].tolist() == [keyframe.frame for keyframe in run.slam.map.keyframes]
    metrics = json.loads((results / "metrics.json").read_text())
    for stage, total in metrics["seconds_per_stage"].items():
        assert (table[f"seconds_{stage}"] >= 0).all()
        # The last attempt to read a frame has no row.
        assert table[f"seconds_{stage}"].sum() == pytest.approx(total, abs=2e-3)
    after_keyframe = table["keyframe"].shift(1, fill_value=False)  # applied with the next frame
    assert (table["seconds_loop"] > 0).tolist() == (table["seconds_bundle"] > 0).tolist() == after_keyframe.tolist()


def test_state_table_has_pose_and_twist_of_the_camera() -> None:
    T_wc = se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.1, -0.7, 0.3], dtype=torch.float64))
    twist, covariance = torch.arange(1.0, 7.0, dtype=torch.float64), torch.arange(36.0).reshape(6, 6)
    record = RunRecord()
    record.states.append_state(
        CameraState(
            stamp=0.5,
            T_wc=T_wc,
            status=TrackingStatus.ODOMETRY,
            covariance=covariance,
            twist=twist,
            twist_covariance=2 * covariance,
            cross_covariance=3 * covariance,
        )
    )
    (row,) = make_state_table(record).to_pylist()
    assert (row["stamp"], row["status"]) == (0.5, "odometry")
    assert [row[name] for name in ("x", "y", "z")] == T_wc[:3, 3].tolist()
    rotation = Rotation.from_quat([row[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
    assert np.allclose(rotation, T_wc[:3, :3].numpy()) and row["qw"] > 0
    assert [row[name] for name in ("vx", "vy", "vz", "wx", "wy", "wz")] == twist.tolist()
    assert row["covariance"] == list(range(36))
    assert row["pose_latency"] is row["latency"] is row["dropped"] is None  # of a stored sequence


def test_ground_truth_is_written_and_gives_the_same_scores(results: Path, run: Pipeline) -> None:
    written, truth = read_trajectory(results / "groundtruth.txt"), run.sequence.groundtruth
    assert truth is not None
    torch.testing.assert_close(written.T_wc, truth.T_wc, rtol=0, atol=1e-8)
    evaluation = evaluate(written, read_trajectory(results / "trajectory.txt"))
    metrics = json.loads((results / "metrics.json").read_text())
    assert evaluation.ate.rmse == pytest.approx(metrics["ate"]["rmse"], abs=1e-7)


def test_object_table_has_a_row_per_frame_and_object(results: Path, run: Pipeline) -> None:
    table = pq.read_table(results / "objects.parquet").to_pandas()
    assert list(table.columns) == [
        *("frame", "stamp", "id", "class", "x", "y", "z", "vx", "vy", "vz", "position_sigma", "velocity_sigma"),
        *("box_x", "box_y", "box_z", "box_length", "box_width", "box_height", "box_yaw"),
        *("votes", "chamfer", "motion_state", "missed"),
    ]
    assert (table[["position_sigma", "velocity_sigma", "box_height"]] > 0).all(axis=None)
    assert len(table) == len(run.record.objects) == FRAMES
    assert table["frame"].tolist() == list(range(FRAMES))
    assert np.allclose(table["stamp"], run.sequence.stamps.numpy())
    assert set(table["motion_state"]) <= {"static", "dynamic", "deforming", "unknown"}


def test_point_map_has_position_and_colours_of_the_wall(results: Path) -> None:
    vertices = plyfile.PlyData.read(results / "map.ply")["vertex"]
    z = np.asarray(vertices["z"])
    assert len(z) > 1000
    assert np.abs(z - WALL).max() < 0.02
    truth = Wall()
    offset = np.asarray(vertices["x"]) * CAMERA.fx / WALL + CAMERA.cx
    row = np.asarray(vertices["y"]) * CAMERA.fy / WALL + CAMERA.cy
    inside = (offset > 2) & (offset < 470) & (row > 2) & (row < 236)
    expected = truth._wall[row[inside].round().astype(int), offset[inside].round().astype(int)].astype(float)
    colours = np.stack([np.asarray(vertices[name])[inside] for name in ("red", "green", "blue")], axis=1)
    for channel in range(3):  # the channels are not swapped
        same = np.corrcoef(colours[:, channel], expected[:, channel])[0, 1]
        other = np.corrcoef(colours[:, channel], expected[:, (channel + 1) % 3])[0, 1]
        assert same > 0.5 > 0.3 > abs(other)


def test_point_map_normals_face_the_camera(results: Path) -> None:
    vertices = plyfile.PlyData.read(results / "map.ply")["vertex"]
    assert np.asarray(vertices["nz"]).max() < -0.9


def test_camera_path_has_every_frame_and_keyframe(results: Path, run: Pipeline) -> None:
    path = plyfile.PlyData.read(results / "trajectory.ply")
    keyframes = len(run.slam.map.keyframes)
    assert (path["vertex"].count, path["face"].count) == (FRAMES + 6 * keyframes, 5 * keyframes)
    assert np.allclose(path["vertex"]["x"][:FRAMES], run.slam.poses.trajectory().T_wc[:, 0, 3])


@pytest.mark.usefixtures("undrawn")
def test_mesh_is_written_if_configured(run: Pipeline, results: Path, tmp_path: Path) -> None:
    assert not (results / "mesh.ply").exists()
    config, with_mesh = run.slam.config, load_config(overrides=["dense_map.mesh.enabled=true"])
    try:
        run.slam.config = with_mesh
        run.flush()
        write_results(tmp_path, run)
    finally:
        run.slam.config = config
    mesh = plyfile.PlyData.read(tmp_path / "mesh.ply")
    assert np.abs(np.asarray(mesh["vertex"]["z"]) - WALL).max() < 0.02
    assert mesh["face"].count > 1000 and mesh["vertex"]["red"].std() > 10


@pytest.mark.usefixtures("undrawn")
def test_mesh_leaves_out_a_part_of_the_map_whose_place_is_a_guess(
    run: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.flush()
    monkeypatch.setattr(run.slam, "config", load_config(overrides=["dense_map.mesh.enabled=true"]))
    ends = []
    for part in (0, 1):
        monkeypatch.setattr(run.slam.map.keyframes[-1], "part", part)
        write_results(tmp_path, run)
        ends.append(float(plyfile.PlyData.read(tmp_path / "mesh.ply")["vertex"]["x"].max()))
    assert ends[1] < ends[0] - 0.1  # the last keyframe is at the right end of the wall


@pytest.mark.usefixtures("undrawn")
def test_keyframe_of_an_earlier_run_is_none_of_this_run_even_at_the_same_time(
    run: Pipeline, results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when a recording is run again in its own map."""
    count, second = len(run.slam.map.keyframes), run.slam.map.keyframes[1]
    monkeypatch.setattr(second, "frame", -1)
    write_results(tmp_path, run)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["keyframes"], metrics["known_keyframes"]) == (count - 1, 1)
    frames = pq.read_table(tmp_path / "frames.parquet").to_pandas()
    stamps = frames["stamp"][frames["keyframe"]].tolist()
    assert stamps == read_trajectory(tmp_path / "keyframes.txt").stamps.tolist()
    assert len(stamps) == count - 1 and second.stamp not in stamps
    green = [plyfile.PlyData.read(folder / "trajectory.ply")["vertex"]["green"] for folder in (results, tmp_path)]
    changed = np.flatnonzero(green[0] != green[1])  # its frustum no longer has the colour of its time
    assert changed.tolist() == list(range(FRAMES + 6, FRAMES + 12))


def test_occupancy_map_is_written_if_configured(
    results: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert not {"occupancy.npz", "occupancy.bt", "map.pgm", "map.yaml"} & {path.name for path in results.iterdir()}
    run = run_along_wall("occupancy.enabled=true")
    run.flush()
    write_results(tmp_path, run)
    assert (tmp_path / "trajectory.txt").read_bytes() == (results / "trajectory.txt").read_bytes()
    stored, wall = load_occupancy(tmp_path / "occupancy.npz"), torch.tensor([[0.0, 0.0, WALL]])
    assert stored.map.distance(wall - torch.tensor([0.0, 0.0, 0.5])).item() == pytest.approx(0.5, abs=0.05)
    assert (stored.map.occupied_points[:, 2] - WALL).abs().max() < 0.05
    assert (tmp_path / "occupancy.bt").read_bytes().startswith(b"# Octomap OcTree binary file\n")
    assert stored.floor is None and not (tmp_path / "map.yaml").exists()  # a wall is no floor
    assert "no floor is visible; no 2D grid was written; let the camera see the floor" in caplog.text
    assert cv2.imread(str(tmp_path / "figures" / "occupancy.png")) is not None


def test_figures_are_images_with_content(results: Path) -> None:
    for name in ("trajectory.png", "masks.png", "clusters.png"):
        image = cv2.imread(str(results / "figures" / name))
        assert image is not None and min(image.shape[:2]) >= 200 and max(image.shape[:2]) <= 4000
        assert len(np.unique(image.astype(np.int64) @ [1, 1 << 8, 1 << 16])) > 10


def test_run_without_ground_truth_has_no_scores(run: Pipeline, tmp_path: Path) -> None:
    without_truth = Pipeline(Wall(), run.slam)
    without_truth.sequence.groundtruth = None  # type: ignore[misc]
    without_truth.record = replace(run.record)
    without_truth.flush()
    assert write_results(tmp_path, without_truth) is None
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["ate"] is metrics["rpe"] is metrics["alignment"] is None and metrics["notes"] == []
    assert (metrics["frames"], metrics["poses"], metrics["coverage"], metrics["pairs"]) == (FRAMES, FRAMES, 1.0, 0)
    assert (tmp_path / "figures" / "trajectory.png").is_file()
    assert not (tmp_path / "groundtruth.txt").exists()


def test_results_that_cannot_be_written_raise_an_error(run: Pipeline, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    run.flush()
    with pytest.raises(OutputError, match=r"file/trajectory\.txt: cannot be written"):
        write_results(tmp_path / "file", run)


@pytest.mark.usefixtures("undrawn")
def test_repeated_run_writes_identical_files(results: Path, tmp_path: Path) -> None:
    again = run_along_wall()
    again.flush()
    write_results(tmp_path, again)
    for name in ("trajectory.txt", "keyframes.txt", "config.yaml", "map.ply", "objects.parquet"):
        assert (tmp_path / name).read_bytes() == (results / name).read_bytes(), name


@pytest.mark.parametrize(
    ("readout", "text"),
    [
        (Readout(0.0, math.inf), "0.0000 s, as the camera states"),
        (Readout(0.024, 1e6), "0.0240 s, standard deviation 0.0010 s"),
        (Readout(0.008, 1e4), "0.0080 s; the images determine it only with a standard deviation of 0.0100 s"),
    ],
)
def test_log_states_whether_the_images_determine_the_readout(readout: Readout, text: str) -> None:
    config = Config().rolling_shutter
    assert describe_readout(readout, config) == text
    assert describe_readout(readout, config.model_copy(update={"enabled": False})) == "not compensated"
