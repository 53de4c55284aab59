"""Result files of a run, and the records of the pipeline that they are made of."""

from __future__ import annotations

import json
import multiprocessing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import plyfile
import pyarrow.parquet as pq
import pytest
import torch
from helpers.wall_run import CAMERA, FRAMES, WALL, Wall, square

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import OutputError
from v3d_torch.evaluation import evaluate
from v3d_torch.frame_result import FrameResult
from v3d_torch.io.files import atomic_write, check_writable, file_lock, write_png, write_text
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.results import write_results
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus


def make_pipeline(sequence: Wall | None = None, masks: Path | None = None, config: Config | None = None) -> Pipeline:
    sequence = sequence or Wall()
    return Pipeline(sequence, V3DSLAM(CAMERA, square, config), masks)


@pytest.fixture(scope="module")
def run() -> Pipeline:
    """Complete run along the wall, with a keyframe every 5 frames."""
    pipeline = make_pipeline(config=load_config(overrides=["mapping.max_keyframe_interval=5"]))
    pipeline()
    return pipeline


@pytest.fixture(scope="module")
def results(run: Pipeline, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "new" / "folder"
    write_results(folder, run)
    return folder


# --- files


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a" / "table.txt"
    write_text(path, "höhe\n")
    assert path.read_bytes() == "höhe\n".encode()
    with pytest.raises(ZeroDivisionError), atomic_write(path) as temporary:
        temporary.write_text("half")
        assert temporary.suffix == ".txt" and temporary.parent == path.parent
        raise ZeroDivisionError
    assert path.read_text(encoding="utf-8") == "höhe\n"
    assert [entry.name for entry in path.parent.iterdir()] == ["table.txt"]


def test_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/x\.txt: cannot be written"):
        write_text(tmp_path / "file" / "x.txt", "")
    with pytest.raises(OutputError, match="No space left"), atomic_write(tmp_path / "y.txt"):
        raise OSError(28, "No space left on device")
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_unwritable_path_is_rejected_before_the_run(tmp_path: Path) -> None:
    check_writable(tmp_path / "new" / "room.map")
    assert (tmp_path / "new").is_dir() and not any((tmp_path / "new").iterdir())
    (tmp_path / "file").write_text("old")
    check_writable(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "old"
    for path in (tmp_path, tmp_path / "file" / "room.map"):
        with pytest.raises(OutputError, match="cannot be written"):
            check_writable(path)


def test_convention_png_is_written_from_rgb(tmp_path: Path) -> None:
    colour = np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    write_png(tmp_path / "colour.png", colour)
    write_png(tmp_path / "grey.png", colour[..., 0])
    assert np.array_equal(cv2.imread(str(tmp_path / "colour.png"))[..., ::-1], colour)
    assert np.array_equal(cv2.imread(str(tmp_path / "grey.png"), cv2.IMREAD_UNCHANGED), colour[..., 0])


def make_folder_once(target: Path) -> None:
    with file_lock(target):
        if not target.exists():
            count = target.with_name("count")
            count.write_text(count.read_text() + "x" if count.exists() else "x")
            target.mkdir()


def test_lock_lets_one_of_many_processes_make_a_folder(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=make_folder_once, args=(tmp_path / "made",)) for _ in range(6)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=30)
    assert [worker.exitcode for worker in workers] == [0] * 6
    assert (tmp_path / "count").read_text() == "x"


# --- the pipeline


def test_run_along_the_wall_is_accurate(run: Pipeline) -> None:
    assert run.slam.poses.statuses == [TrackingStatus.TRACKED] * FRAMES
    truth = run.sequence.groundtruth
    assert truth is not None
    error = (run.slam.poses.trajectory().T_wc - truth.T_wc)[:, :3, 3].norm(dim=1)
    assert error.max() < 0.01
    assert run.record.failure is None and run.record.seconds > 0


def test_callback_and_record_have_every_frame_and_object() -> None:
    reported: list[tuple[int, int, TrackingStatus]] = []

    def on_frame(frame: RGBDFrame, result: FrameResult) -> None:
        reported.append((frame.index, len(result.objects), result.status))

    pipeline = make_pipeline()
    record = pipeline(on_frame)
    assert reported == [(index, 1, TrackingStatus.TRACKED) for index in range(FRAMES)]
    assert [row["frame"] for row in record.dynamics] == list(range(FRAMES))
    assert {row["class"] for row in record.dynamics} == {"person"}
    assert record.dynamics[-1]["z"] == pytest.approx(WALL, abs=0.02)
    assert (stamps := [snapshot.frame.stamp for snapshot in record.snapshots]) == sorted(stamps)
    assert len(record.snapshots) == 6
    assert set(pipeline.slam.timer.seconds) >= {"read", "segmentation", "objects", "tracking", "mapping"}
    assert max(pipeline.slam.timer.seconds.values()) <= record.seconds


@pytest.mark.parametrize("broken", [0, 1, 5])
def test_broken_frame_ends_the_run_and_keeps_the_frames_before(broken: int, tmp_path: Path) -> None:
    pipeline = make_pipeline(Wall(broken=broken))
    record = pipeline()
    assert record.failure is not None and "truncated" in record.failure
    evaluation = write_results(tmp_path, pipeline)
    lines = (tmp_path / "trajectory.txt").read_text().splitlines()
    assert len(lines) == broken
    assert (evaluation is not None) == (broken >= 3)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["processed"], metrics["frames"]) == (broken, FRAMES)
    assert metrics["failure"] == record.failure
    assert (tmp_path / "map.ply").is_file() and (tmp_path / "dynamics.parquet").is_file()


def test_interrupt_ends_the_run_and_keeps_the_frames_before(tmp_path: Path) -> None:
    pipeline = make_pipeline(Wall(interrupted=4))
    assert pipeline().failure == f"interrupted after 4 of {FRAMES} frames"
    write_results(tmp_path, pipeline)
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == 4


def test_mask_images_show_the_masked_pixels(tmp_path: Path) -> None:
    no_margins = [
        *("objects.clouds.stride=1", "objects.static_mask.depth_margin=0", "objects.static_mask.dilation=0"),
        "objects.free_space.enabled=false",
    ]
    config = load_config(overrides=[*no_margins, "objects.static_mask.confirm_static_time=100"])
    make_pipeline(masks=tmp_path / "masks", config=config)()
    paths = sorted((tmp_path / "masks").iterdir())
    assert [path.name for path in paths] == [f"{index / 10:.6f}.png" for index in range(FRAMES)]
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image.dtype == np.uint8
        assert np.array_equal(image, np.where(square(Wall()[0]).masks[0].numpy(), 255, 0))


def test_masks_that_cannot_be_written_end_the_run_with_a_message(tmp_path: Path) -> None:
    (tmp_path / "masks").write_text("")
    failure = make_pipeline(masks=tmp_path / "masks")().failure
    assert failure is not None and "masks" in failure and "cannot be written" in failure


# --- the files of a run


def test_all_documented_files_are_written(results: Path) -> None:
    names = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file()}
    assert names == {
        *("trajectory.txt", "keyframes.txt", "groundtruth.txt", "config.yaml", "metrics.json"),
        *("frames.parquet", "dynamics.parquet", "map.ply", "trajectory.ply"),
        *("figures/trajectory.png", "figures/masks.png", "figures/clusters.png"),  # a single object has no votes
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
    assert metrics["seed"] == 0 and metrics["versions"]["torch"] == torch.__version__
    assert max(metrics["seconds_per_stage"].values()) <= metrics["seconds"]  # stages overlap


def test_frame_table_has_status_keyframe_and_stage_times(results: Path, run: Pipeline) -> None:
    table = pq.read_table(results / "frames.parquet").to_pandas()
    assert table["frame"].tolist() == list(range(FRAMES))
    assert np.allclose(table["stamp"], run.sequence.stamps.numpy())
    assert set(table["status"]) == {"tracked"}
    assert table["frame"][table["keyframe"]].tolist() == [keyframe.frame for keyframe in run.slam.map.keyframes]
    metrics = json.loads((results / "metrics.json").read_text())
    for stage, total in metrics["seconds_per_stage"].items():
        assert (table[f"seconds_{stage}"] >= 0).all()
        assert table[f"seconds_{stage}"].sum() == pytest.approx(
            total, abs=2e-3
        )  # the last attempt to read a frame has no row
    after_keyframe = table["keyframe"].shift(1, fill_value=False)  # applied with the next frame
    assert (table["seconds_loop"] > 0).tolist() == (table["seconds_bundle"] > 0).tolist() == after_keyframe.tolist()


def test_ground_truth_is_written_and_gives_the_same_scores(results: Path, run: Pipeline) -> None:
    written, truth = read_trajectory(results / "groundtruth.txt"), run.sequence.groundtruth
    assert truth is not None
    torch.testing.assert_close(written.T_wc, truth.T_wc, rtol=0, atol=1e-8)
    evaluation = evaluate(written, read_trajectory(results / "trajectory.txt"))
    metrics = json.loads((results / "metrics.json").read_text())
    assert evaluation.ate.rmse == pytest.approx(metrics["ate"]["rmse"], abs=1e-7)


def test_object_table_has_a_row_per_frame_and_object(results: Path, run: Pipeline) -> None:
    table = pq.read_table(results / "dynamics.parquet").to_pandas()
    assert list(table.columns) == [
        *("frame", "stamp", "id", "class", "x", "y", "z", "votes", "chamfer", "motion_state", "missed")
    ]
    assert len(table) == len(run.record.dynamics) == FRAMES
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


def test_mesh_is_written_if_configured(run: Pipeline, results: Path, tmp_path: Path) -> None:
    assert not (results / "mesh.ply").exists()
    config, with_mesh = run.slam.config, load_config(overrides=["dense_map.mesh.enabled=true"])
    try:
        run.slam.config = with_mesh
        write_results(tmp_path, run)
    finally:
        run.slam.config = config
    mesh = plyfile.PlyData.read(tmp_path / "mesh.ply")
    assert np.abs(np.asarray(mesh["vertex"]["z"]) - WALL).max() < 0.02
    assert mesh["face"].count > 1000 and mesh["vertex"]["red"].std() > 10


def test_figures_are_images_with_content(results: Path) -> None:
    for name in ("trajectory.png", "masks.png", "clusters.png"):
        image = cv2.imread(str(results / "figures" / name))
        assert image is not None and min(image.shape[:2]) >= 200 and max(image.shape[:2]) <= 4000
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10


def test_run_without_ground_truth_has_no_scores(run: Pipeline, tmp_path: Path) -> None:
    without_truth = Pipeline(Wall(), run.slam)
    without_truth.sequence.groundtruth = None  # type: ignore[misc]
    without_truth.record = replace(run.record)
    assert write_results(tmp_path, without_truth) is None
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert "rmse" not in (metrics.get("ate") or {})
    assert metrics["frames"] == FRAMES
    assert (tmp_path / "figures" / "trajectory.png").is_file()
    assert not (tmp_path / "groundtruth.txt").exists()


def test_results_that_cannot_be_written_raise_an_error(run: Pipeline, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/trajectory\.txt: cannot be written"):
        write_results(tmp_path / "file", run)


def test_repeated_run_writes_identical_files(results: Path, tmp_path: Path) -> None:
    repeated = make_pipeline(config=load_config(overrides=["mapping.max_keyframe_interval=5"]))
    repeated()
    write_results(tmp_path, repeated)
    for name in ("trajectory.txt", "keyframes.txt", "config.yaml", "map.ply", "dynamics.parquet"):
        assert (tmp_path / name).read_bytes() == (results / name).read_bytes(), name
