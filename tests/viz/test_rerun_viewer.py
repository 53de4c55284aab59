"""Rerun recordings read back and compared with the run; runs without a viewer; viewers that cannot be shown."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
import rerun_cli
import torch
from helpers.demo_frames import copy_frames
from helpers.short_wall import CAMERA, FRAMES, WALL, Wall
from helpers.square_segmenter import squares
from helpers.waiting import wait_until
from matplotlib.colors import to_rgba
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from typer.testing import CliRunner, Result

from v3d_torch.cli import run
from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError, OutputError, ViewerError
from v3d_torch.frame_result import FrameResult
from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid
from v3d_torch.pipeline import Pipeline
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, Trajectory
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS
from v3d_torch.viz.rerun import viewer as viewer_module
from v3d_torch.viz.rerun.objects import CLASS_IDS
from v3d_torch.viz.rerun.occupancy import log_floor
from v3d_torch.viz.rerun.stream import open_stream
from v3d_torch.viz.rerun.viewer import RerunViewer
from v3d_torch.viz.viewer import make_viewer
from v3d_torch.viz.voting import split_votes

Row = dict[str, Any]


class Recording:
    """Rows of a recording by entity, in the order of logging."""

    def __init__(self, path: Path) -> None:
        self._rows: dict[str, list[tuple[int, int | None, Row]]] = {}
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            for i in range(batch.num_rows):
                row = {name: batch.column(name)[i].as_py() for name in batch.schema.names}
                order, frame = int(row.pop("rerun.controls.RowId").hex(), 16), row.get("frame")
                parts = {name.split(":")[-1]: value for name, value in row.items()}
                self._rows.setdefault(chunk.entity_path, []).append((order, frame, parts))
        for rows in self._rows.values():
            rows.sort(key=lambda row: row[0])

    @property
    def entities(self) -> set[str]:
        """Paths of all entities of the run."""
        return {path for path in self._rows if not path.startswith("/__")}

    def at(self, entity: str) -> dict[int | None, Row]:
        """Return the last row of each frame."""
        return {frame: row for _, frame, row in self._rows[entity]}

    def all(self, entity: str) -> list[Row]:
        """Return all rows."""
        return [row for _, _, row in self._rows[entity]]


class RunLog:
    """State of the SLAM system after each frame, for comparison with the recording."""

    def __init__(self, slam: V3DSLAM) -> None:
        self._slam = slam
        self.results: list[FrameResult] = []
        self.frames: list[RGBDFrame] = []
        self.T_wc: list[NDArray[np.float64]] = []
        self.positions: list[NDArray[np.float64]] = []
        self.keyframes: list[list[int]] = []
        self.landmarks: list[int] = []

    def __call__(self, frame: RGBDFrame, result: FrameResult) -> None:
        self.frames.append(frame)
        self.results.append(result)
        self.T_wc.append(invert(self._slam.poses.T_cw).numpy())
        self.positions.append(self._slam.poses.trajectory().T_wc[:, :3, 3].numpy())
        self.keyframes.append([keyframe.frame for keyframe in self._slam.map.keyframes])
        self.landmarks.append(int(self._slam.map.landmarks["active"].sum()))


CONFIG = (
    *("mapping.max_keyframe_interval=5", "objects.free_space.enabled=false"),
    *("objects.voting.time_spans=[0.3]", "objects.chamfer.time_span=0.0", "occupancy.enabled=true"),
)
"""A keyframe every five frames, and the paper's voting, over a time span so long that Chamfer distances are measured
before an object is voted dynamic."""


class Tilted(Wall):
    """The wall, with a ground truth in another world frame that begins before the first image."""

    T_gw = se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.5, -0.3, 0.2], dtype=torch.float64))

    def __init__(self) -> None:
        super().__init__()
        assert self.groundtruth is not None
        poses = torch.cat([torch.eye(4, dtype=torch.float64)[None], self.groundtruth.T_wc])
        self.groundtruth = Trajectory(torch.cat([torch.tensor([-5.0]).double(), self.stamps]), self.T_gw @ poses)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, RunLog, Pipeline]:
    path = tmp_path_factory.mktemp("rerun") / "new" / "folder" / "run.rrd"
    sequence = Tilted()
    slam = V3DSLAM(CAMERA, squares, load_config(overrides=CONFIG))
    log = RunLog(slam)
    pipeline = Pipeline(sequence, slam, viewer=make_viewer(None, path, sequence))
    run = pipeline(log)
    pipeline.flush()
    pipeline.fuse_points()
    assert run.failure is None
    return Recording(path), log, pipeline


# --- content of a recording


def test_recording_has_all_entities(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    recording, _, pipeline = recorded
    world = ("camera", "objects", "centroids", "votes", "votes/without_effect", "trajectory", "trajectory/newest")
    image = ("", "/rgb", "/depth", "/masks", "/objects")
    stages = [stage for stage in pipeline.slam.timer.seconds if stage != "viewer"]
    assert recording.entities >= {
        "/world",
        *(f"/world/{name}" for name in (*world, "map/landmarks", "map/keyframes", "groundtruth", "occupancy")),
        *(f"/world/camera/image{name}" for name in image),
        *(f"/seconds/{stage}" for stage in stages),
        *("/votes/1", "/votes/2", "/votes/3", "/chamfer/1", "/frame_summary", "/log"),
    }


def test_convention_camera_pose_is_camera_to_world(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    recording, log, pipeline = recorded
    rows = recording.at("/world/camera")
    assert list(rows) == list(range(FRAMES))
    for index, row in rows.items():
        assert index is not None
        np.testing.assert_allclose(row["translation"][0], log.T_wc[index][:3, 3], atol=1e-6)
        R = np.reshape(row["mat3x3"][0], (3, 3)).T  # column by column
        np.testing.assert_allclose(R, log.T_wc[index][:3, :3], atol=1e-6)
    assert [row["stamp"].timestamp() for row in rows.values()] == pytest.approx(pipeline.sequence.stamps.tolist())
    (pinhole,) = recording.all("/world/camera/image")
    np.testing.assert_allclose(np.reshape(pinhole["image_from_camera"][0], (3, 3)).T, CAMERA.K)
    assert pinhole["resolution"][0] == [CAMERA.width, CAMERA.height]


def test_images_equal_those_of_the_frame(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    recording, log, _ = recorded
    for index, frame in enumerate(log.frames):
        jpeg = np.array(recording.at("/world/camera/image/rgb")[index]["blob"][0], dtype=np.uint8)
        image = cv2.imdecode(jpeg, cv2.IMREAD_COLOR_RGB).astype(float)
        assert np.abs(image - frame.image.permute(1, 2, 0).numpy()).mean() < 12  # noise, in JPEG
        row = recording.at("/world/camera/image/depth")[index]
        depth = cv2.imdecode(np.array(row["blob"][0], dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16 and set(np.unique(depth)) == {round(WALL * row["meter"][0])}


def test_motion_states_have_the_colours_of_the_figures(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    """In the masks, in the boxes and in the clouds."""
    recording, log, _ = recorded
    (world,) = recording.all("/world")
    classes = {entry["class_id"]: entry["class_description"]["info"] for entry in world["context"][0]}
    for motion_state, number in CLASS_IDS.items():
        assert classes[number]["label"] == motion_state.value
        red, green, blue = (round(255 * part) for part in to_rgba(MOTION_STATE_COLOURS[motion_state])[:3])
        assert classes[number]["color"] == red << 24 | green << 16 | blue << 8 | 255
    assert classes[0]["color"] & 255 == 0
    present = set()
    for index, result in enumerate(log.results):
        buffer = np.array(recording.at("/world/camera/image/masks")[index]["buffer"][0], dtype=np.uint8)
        expected = np.zeros((240, 320), dtype=np.uint8)
        for obj in result.objects:
            expected[obj.mask.numpy()] = CLASS_IDS[obj.motion_state]
        assert np.array_equal(buffer.reshape(240, 320), expected)
        boxes = recording.at("/world/camera/image/objects")[index]
        assert boxes["labels"] == ["person 1", "chair 2", "tv 3"]
        assert boxes["class_ids"] == [CLASS_IDS[obj.motion_state] for obj in result.objects]
        sides = [[torch.nonzero(obj.mask.any(dim=axis))[[0, -1], 0] for axis in (0, 1)] for obj in result.objects]
        np.testing.assert_allclose(boxes["half_sizes"], [[(b - a + 1) / 2 for a, b in sizes] for sizes in sides])
        np.testing.assert_allclose(boxes["centers"], [[(a + b + 1) / 2 for a, b in sizes] for sizes in sides])
        cloud = recording.at("/world/objects")[index]
        points = torch.cat([obj.cloud for obj in result.objects])
        np.testing.assert_allclose(cloud["positions"], points, atol=1e-6)
        counts = {state: cloud["class_ids"].count(number) for state, number in CLASS_IDS.items()}
        for state in MotionState:
            assert counts[state] == sum(len(obj.cloud) for obj in result.objects if obj.motion_state is state)
        present |= {obj.motion_state for obj in result.objects}
    assert MotionState.DYNAMIC in present and MotionState.STATIC in present


def test_votes_are_red_lines_between_centroids(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    recording, log, _ = recorded
    drawn = 0
    for index, result in enumerate(log.results):
        centroid = {obj.id: obj.centroid.numpy() for obj in result.objects}
        np.testing.assert_allclose(recording.at("/world/centroids")[index]["positions"], list(centroid.values()))
        dynamic = [obj.id for obj in result.objects if obj.motion_state is MotionState.DYNAMIC]
        for entity, pairs in zip(("", "/without_effect"), split_votes(result.vote_pairs, dynamic), strict=True):
            row = recording.at(f"/world/votes{entity}")[index]
            assert len(row["strips"]) == len(pairs)
            for strip, (first, second) in zip(row["strips"], pairs, strict=True):
                np.testing.assert_allclose(strip, [centroid[first], centroid[second]], atol=1e-6)
            drawn += len(pairs) if not entity else 0
            red, green, blue = (row["colors"][0] >> shift & 255 for shift in (24, 16, 8))
            assert red > 200 and green == blue < 140
        votes = [recording.at(f"/votes/{obj.id}")[index]["scalars"][0] for obj in result.objects]
        assert votes == [obj.votes for obj in result.objects]
    assert drawn > 0


def test_occupied_voxels_are_logged(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    recording, _, pipeline = recorded
    rows, mapper = recording.all("/world/occupancy"), pipeline.slam.occupancy
    assert mapper is not None and len(rows) > 2
    np.testing.assert_allclose(rows[-1]["positions"], mapper.map.occupied_points, atol=1e-6)
    assert rows[-1]["radii"] == [pytest.approx(0.025)] and len(rows[-1]["colors"]) == len(rows[-1]["positions"])


def test_free_cells_are_logged_on_the_floor(tmp_path: Path) -> None:
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    states = torch.tensor([[0, 1, -1], [0, 0, 1]], dtype=torch.int8)
    stream = open_stream(live=False, file=tmp_path / "floor.rrd")
    log_floor(stream, OccupancyGrid(states, 0.1, (1.0, -2.0), level_frame(up), -1.5))
    stream.disconnect()
    (row,) = Recording(tmp_path / "floor.rrd").all("/world/occupancy/floor")
    # x of the grid is z of the world, y is -x; the floor is 1.5 m below the camera.
    expected = [(1.95, 1.5, 1.05), (1.85, 1.5, 1.05), (1.85, 1.5, 1.15)]
    np.testing.assert_allclose(row["positions"], expected, atol=1e-6)


def test_map_and_poses_are_logged_again_after_each_keyframe(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    recording, log, _ = recorded
    frustums, points = recording.at("/world/map/keyframes"), recording.at("/world/map/landmarks")
    paths, newest = recording.at("/world/trajectory"), recording.at("/world/trajectory/newest")
    last = FRAMES - 1
    keyframes = log.keyframes[-1]
    adjusted = [index + 1 for index in keyframes if index < last]
    assert keyframes[:2] == [0, 5] and set(frustums) == set(points) == set(paths) == {*adjusted, last}
    for index in adjusted:
        assert len(frustums[index]["strips"]) == len(log.keyframes[index])
        assert len(points[index]["positions"]) == log.landmarks[index] > 50
        centre = np.array(frustums[index]["strips"])[:, 5]  # camera centre
        np.testing.assert_allclose(centre, [log.T_wc[frame][:3, 3] for frame in log.keyframes[index]], atol=5e-3)
    for index in adjusted:
        np.testing.assert_allclose(paths[index]["strips"][0], log.positions[index], atol=1e-6)
    np.testing.assert_allclose(paths[last]["strips"][0], log.positions[last], atol=1e-6)
    assert newest[0]["strips"] == []  # a line needs two points
    np.testing.assert_allclose(newest[3]["strips"][0], log.positions[3][1:], atol=1e-6)
    np.testing.assert_allclose(newest[8]["strips"][0], log.positions[8][6:], atol=1e-6)


def test_only_the_recent_part_is_logged_until_the_map_has_grown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer_module, "_MAP_GROWTH", 1.9)
    sequence = Tilted()
    slam = V3DSLAM(CAMERA, squares, load_config(overrides=[*CONFIG, "mapping.max_keyframe_interval=2"]))
    log = RunLog(slam)
    pipeline = Pipeline(sequence, slam, viewer=make_viewer(None, tmp_path / "run.rrd", sequence))
    assert pipeline(log).failure is None
    pipeline.flush()
    pipeline.fuse_points()
    recording, last = Recording(tmp_path / "run.rrd"), FRAMES - 1
    whole, recent = recording.at("/world/map/keyframes"), recording.at("/world/map/keyframes/recent")
    points, newer = recording.at("/world/map/landmarks"), recording.at("/world/map/landmarks/recent")
    paths, later = recording.at("/world/trajectory"), recording.at("/world/trajectory/recent")
    assert set(whole) == set(points) == set(paths) == set(recording.at("/world/occupancy"))
    assert set(recent) == set(newer) == set(later) and last in whole and len(whole) <= 4 < len(recent)
    logged = 0
    for index in sorted(recent):  # together they are the whole map
        logged = index if index in whole else logged
        counts = len(whole[logged]["strips"]), len(recent[index]["strips"])
        assert sum(counts) == len(log.keyframes[index]) and (counts[1] == 0) == (index == logged)
        if index == logged:
            assert len(newer[index]["positions"]) < log.landmarks[index]
        assert len(paths[logged]["strips"][0]) == logged + 1
        path = np.array(later[index]["strips"][0]) if index != logged else np.zeros((0, 3))
        np.testing.assert_allclose(path, log.positions[index][logged:] if len(path) else path, atol=1e-6)
    assert len(points[last]["positions"]) == log.landmarks[last] and newer[last]["positions"] == []
    np.testing.assert_allclose(paths[last]["strips"][0], log.positions[last], atol=1e-6)


def test_ground_truth_is_aligned_at_first_pose(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    recording, _, pipeline = recorded
    truth = pipeline.sequence.groundtruth
    assert truth is not None
    (row,) = recording.all("/world/groundtruth")
    expected = (invert(Tilted.T_gw) @ truth.T_wc)[:, :3, 3]  # the world frame of the estimate is the first camera frame
    np.testing.assert_allclose(row["strips"][0], expected, atol=1e-5)
    assert row["frame"] == 0


def test_curves_summaries_and_events(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    recording, log, pipeline = recorded
    times = pipeline.record.times
    for stage, seconds in zip(times.stages, times.wall.T.tolist(), strict=True):
        if stage == "viewer":  # it cannot show how long it takes
            continue
        logged = recording.at(f"/seconds/{stage}")
        ran = [index for index, spent in enumerate(seconds) if spent]
        assert [logged[index]["scalars"][0] for index in ran] == pytest.approx([seconds[index] for index in ran])
    for index, result in enumerate(log.results):
        text = recording.at("/frame_summary")[index]["text"][0]
        assert f"**frame {index}** at {index / 10:.3f} s: tracked" in text
        assert all(f"| {obj.motion_state.value} | {obj.votes} |" in text for obj in result.objects)
        chamfer = [obj.chamfer for obj in result.objects if obj.id == 1]
        if np.isfinite(chamfer[0]):
            assert recording.at("/chamfer/1")[index]["scalars"] == chamfer
    events = {frame: row["text"][0] for frame, row in recording.at("/log").items()}
    assert events == {frame: f"keyframe {i}" for i, frame in enumerate(log.keyframes[-1])}
    assert pipeline.slam.timer.seconds["viewer"] > 0


def test_map_and_poses_are_logged_again_after_loop_correction(tmp_path: Path) -> None:
    """The map is moved as by a loop correction, before a frame that becomes a keyframe."""
    sequence = Wall()
    slam = V3DSLAM(CAMERA, squares, load_config(overrides=CONFIG))
    viewer = make_viewer(None, tmp_path / "run.rrd", sequence)
    log = RunLog(slam)

    def on_frame(frame: RGBDFrame, result: FrameResult) -> None:
        if frame.index == FRAMES - 1:
            T_new_old = se3_exp(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.3, 0.0], dtype=torch.float64))
            slam.map.move_keyframes(slam.map.T_cw @ invert(T_new_old))
            slam.loop_closer.loop_count += 1
            slam.map.keyframes[-1].stamp = frame.stamp
            viewer.show(frame, result, slam, {})
        log(frame, result)

    pipeline = Pipeline(sequence, slam, viewer=viewer)
    pipeline(on_frame)
    pipeline.flush()
    pipeline.fuse_points()
    recording = Recording(tmp_path / "run.rrd")
    moved = recording.at("/world/trajectory")[FRAMES - 1]["strips"][0]
    np.testing.assert_allclose(moved, slam.poses.trajectory().T_wc[:, :3, 3], atol=1e-6)
    assert np.linalg.norm(np.array(moved[0])) > 0.4  # the first pose is moved as well
    centres = np.array(recording.at("/world/map/keyframes")[FRAMES - 1]["strips"])[:, 5]
    np.testing.assert_allclose(centres, invert(slam.map.T_cw)[:, :3, 3], atol=1e-6)
    assert "loop closed" in recording.at("/log")[FRAMES - 1]["text"][0]
    np.testing.assert_allclose(
        recording.at("/world/camera")[FRAMES - 1]["translation"][0], invert(slam.poses.T_cw)[:3, 3], atol=1e-6
    )


def test_ground_truth_without_orientations_is_not_logged(tmp_path: Path) -> None:
    sequence = Wall()
    assert sequence.groundtruth is not None
    sequence.groundtruth.T_wc[:, :3, :3] = torch.eye(3, dtype=torch.float64)
    pipeline = Pipeline(sequence, V3DSLAM(CAMERA, squares), viewer=make_viewer(None, tmp_path / "run.rrd", sequence))
    pipeline()
    pipeline.flush()
    pipeline.fuse_points()
    assert "/world/groundtruth" not in Recording(tmp_path / "run.rrd").entities


# --- runs without a viewer, and viewers that cannot be shown


def test_run_without_options_has_no_viewer() -> None:
    assert make_viewer(None, None, Wall()) is None


def test_poses_are_the_same_with_and_without_a_viewer(recorded: tuple[Recording, RunLog, Pipeline]) -> None:
    _, _, with_viewer = recorded
    without_viewer = Pipeline(Tilted(), V3DSLAM(CAMERA, squares, load_config(overrides=CONFIG)))
    without_viewer()
    without_viewer.flush()
    assert torch.equal(without_viewer.slam.poses.trajectory().T_wc, with_viewer.slam.poses.trajectory().T_wc)
    assert "viewer" not in without_viewer.slam.timer.seconds


def test_unknown_viewer_unwritable_file_and_missing_library_are_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="--viz open3d: unknown viewer; use --viz rerun"):
        make_viewer("open3d", None, Wall())
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"run\.rrd: cannot be written"):
        make_viewer(None, tmp_path / "file" / "run.rrd", Wall())
    with pytest.raises(OutputError, match="cannot be written"):
        make_viewer(None, tmp_path, Wall())
    monkeypatch.setitem(sys.modules, "rerun", None)
    for viz, option in (("rerun", "--viz rerun"), (None, "--rerun")):
        with pytest.raises(ViewerError, match=rf"{option}: needs rerun-sdk .*; run pip install 'v3d-torch\[rerun\]'"):
            make_viewer(viz, tmp_path / "run.rrd", Wall())


@pytest.mark.parametrize("viz", [None, "rerun"])
def test_existing_recording_is_an_error_and_stays(viz: str | None, tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    file.write_text("precious")
    with pytest.raises(OutputError, match=r"run\.rrd: already exists; delete it, or choose another file with --rerun"):
        make_viewer(viz, file, Wall())
    assert file.read_text() == "precious"


def test_name_that_the_viewer_does_not_open_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"run\.rec: .*; choose a name that ends in \.rrd"):
        make_viewer(None, tmp_path / "run.rec", Wall())
    assert not list(tmp_path.iterdir())


def test_incomplete_recording_is_a_failure_after_all_frames(tmp_path: Path) -> None:
    class Full(RerunViewer):
        def _log_map(self, slam: V3DSLAM) -> None:
            """Log nothing: `flush` below raises the library's error for a full disk."""

    sequence = Wall()
    viewer = Full(open_stream(live=False, file=tmp_path / "run.rrd"), CAMERA, None, "wall")

    def flush(timeout_sec: float) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    viewer._stream.flush = flush  # type: ignore[method-assign, assignment]
    pipeline = Pipeline(sequence, V3DSLAM(CAMERA, squares), viewer=viewer)
    pipeline()
    pipeline.flush()
    pipeline.fuse_points()
    failure = pipeline.record.failure
    assert failure is not None and "the rerun recording is incomplete (File-writer" in failure
    assert len(pipeline.slam.poses.statuses) == FRAMES


# --- live viewer, replaced by rerun's server without a window


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[Path, Path]]:
    """Program that replaces the viewer, without a window, and the file in which it saves the received data."""
    script, saved, pid = tmp_path / "bin" / "rerun", tmp_path / "received.rrd", tmp_path / "pid"
    script.parent.mkdir()
    program = str(Path(rerun_cli.__file__).with_name("rerun"))
    script.write_text(
        f"#!{sys.executable}\n"
        "import os, sys\n"
        f"open({str(pid)!r}, 'w').write(str(os.getpid()))\n"
        f"os.execv({program!r}, ['rerun', '--serve-grpc', '--save', {str(saved)!r}, *sys.argv[1:]])\n"
    )
    script.chmod(0o755)
    yield script, saved
    if pid.is_file():
        os.kill(int(pid.read_text()), signal.SIGTERM)


def test_viewer_is_started_and_receives_the_run(
    server: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script, saved = server
    monkeypatch.setattr(sys, "executable", str(script.with_name("python")))
    monkeypatch.setenv("DISPLAY", ":0")
    port = free_port()
    file = tmp_path / "file.rrd"
    viewer = RerunViewer(open_stream(live=True, file=file, port=port), CAMERA, None, "wall")
    pipeline = Pipeline(Wall(broken=3), V3DSLAM(CAMERA, squares), viewer=viewer)
    (viewer_process,) = [child for child in psutil.Process().children() if f"--port={port}" in child.cmdline()]
    listening = [at.laddr.ip for at in viewer_process.net_connections() if at.status == psutil.CONN_LISTEN]
    assert listening == ["127.0.0.1"]  # private images must not be accessible from the network
    pipeline()
    pipeline.flush()
    pipeline.fuse_points()
    assert list(Recording(file).at("/world/camera")) == [0, 1, 2]
    wait_until(lambda: saved.is_file() and saved.stat().st_size > 10_000, timeout=20, what="the viewer saved the run")


@pytest.mark.usefixtures("undrawn")
def test_command_without_screen_suggests_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy_frames(tmp_path / "three", range(45, 48))
    for name in list(os.environ):
        if "DISPLAY" in name or "WAYLAND" in name:
            monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> Result:
        return CliRunner().invoke(run.app, ["--seq", str(tmp_path / "three"), "--segmenter", "none", *arguments])

    if sys.platform == "linux":
        done = call("--viz", "rerun", "--out", str(tmp_path / "out"))
        assert done.exit_code == 2 and not (tmp_path / "out").exists()
        assert done.stderr.startswith("error: --viz rerun: no screen to open a viewer on; record")
        assert done.stderr.count("\n") == 1
        assert "--rerun FILE.rrd" in done.stderr
    done = call("--rerun", "three.rrd", "--out", str(tmp_path / "out"))
    assert (done.exit_code, done.stderr) == (0, "")
    recording = Recording(tmp_path / "three.rrd")
    assert list(recording.at("/world/camera")) == [0, 1, 2]
    assert recording.at("/world/objects")[2]["positions"] == []
