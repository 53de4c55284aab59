"""Bags of whole runs, read back by two libraries and compared with the run; bags that cannot be written."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import long_wall
from helpers.bag_messages import (
    Messages,
    lookup,
    matrix_of,
    points_of,
    read_with_mcap,
    read_with_rosbags,
    stamp_of,
)
from helpers.short_wall import CAMERA, FRAMES, WALL, Wall
from helpers.square_segmenter import squares
from mcap.reader import make_reader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader

from v3d_torch.config.loading import load_config
from v3d_torch.errors import OutputError
from v3d_torch.export.ros.bag_file import BagFile
from v3d_torch.export.ros.bag_viewer import BagViewer
from v3d_torch.export.ros.frames import camera_in_map, map_frame, points_in_map
from v3d_torch.export.ros.messages import occupancy_grid, transforms
from v3d_torch.export.ros.run_messages import RunMessages
from v3d_torch.frame_result import FrameResult
from v3d_torch.geometry.se3 import invert, se3_exp, transform_points
from v3d_torch.occupancy.occupancy_grid import OccupancyGrid
from v3d_torch.pipeline import Pipeline
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.slam import V3DSLAM
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.types import RGBDFrame, TrackingStatus

CONFIG = load_config(overrides=["mapping.max_keyframe_interval=5"])
AS_SEEN = map_frame(None)
DELETEALL = 3
EVERY_FRAME = ("/tf", "/odom", "/camera/color/camera_info", "/objects")


class Recorded:
    """Run along the wall, recorded in a bag, with the pose of each frame when it was tracked."""

    def __init__(self, path: Path, sequence: Wall | None = None) -> None:
        self.path = path
        self.T_wc: list[torch.Tensor] = []
        self.keyframes = 0
        self.states: list[CameraState] = []
        slam = V3DSLAM(CAMERA, squares, CONFIG)
        self.pipeline = Pipeline(sequence or Wall(), slam, viewer=BagViewer(path, CAMERA))
        self.pipeline(self._on_frame)
        self.pipeline.flush()
        self.point_map: PointMap = self.pipeline.fuse_points()

    def _on_frame(self, frame: RGBDFrame, result: FrameResult) -> None:
        self.T_wc.append(result.T_wc)
        self.states.append(self.pipeline.slam.states.at(frame.stamp))
        self.keyframes = len(self.pipeline.slam.map.keyframes)


class Dark(Wall):
    """Wall that is dark, without depth, from a frame on."""

    def __init__(self, from_frame: int) -> None:
        super().__init__()
        self._dark_from = from_frame

    def __getitem__(self, index: int) -> RGBDFrame:
        frame = super().__getitem__(index)
        return replace(frame, image=frame.image * 0, depth=frame.depth * 0) if index >= self._dark_from else frame


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    run = Recorded(tmp_path_factory.mktemp("bag") / "new" / "run.mcap")
    assert run.pipeline.record.failure is None
    return run


@pytest.fixture(scope="module", params=[read_with_mcap, read_with_rosbags])
def messages(recorded: Recorded, request: pytest.FixtureRequest) -> Messages:
    read: Any = request.param
    return read(recorded.path)


def test_file_states_profile_schemas_and_encodings_of_ros2(recorded: Recorded) -> None:
    with recorded.path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None and reader.get_header().profile == "ros2"
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
            assert schema.name.split("/")[1] == "msg" and b"MSG: std_msgs/Header" in schema.data
        assert summary.statistics is not None and summary.chunk_indexes
    with Reader(recorded.path) as reader2:
        assert {each.topic: each.msgcount for each in reader2.connections} == {
            **dict.fromkeys(EVERY_FRAME, FRAMES),
            "/cloud": recorded.keyframes,
            "/path": recorded.keyframes + 1,
            "/cloud_map": 1,
        }


def test_map_is_played_to_subscribers_that_start_later_also_by_distributions_after_humble(tmp_path: Path) -> None:
    """The topic of the map of nav2 has the durability that nav2 requests; other topics have that of most publishers."""
    path, grid = tmp_path / "run.mcap", OccupancyGrid(torch.zeros(2, 3, dtype=torch.int8), 0.05, (0, 0), AS_SEEN, 0)
    bag = BagFile(path)
    bag.write("/map", occupancy_grid(1.0, "map", grid, AS_SEEN), 1)
    bag.write("/tf", transforms(1.0, {}), 1)
    bag.close()
    with Reader(path) as reader:
        profiles = {each.topic: each.ext.offered_qos_profiles for each in reader.connections}
    assert profiles["/tf"] == []
    assert [(each.durability, each.reliability) for each in profiles["/map"]] == [
        (QosDurability.TRANSIENT_LOCAL, QosReliability.RELIABLE)
    ]
    with path.open("rb") as file:  # without this record, they expect names instead of numbers
        assert [each.name for each in make_reader(file).iter_metadata()] == ["rosbag2"]


def test_times_are_those_of_the_frames_and_never_decrease(messages: Messages) -> None:
    for topic in EVERY_FRAME:
        times = [time for time, _ in messages[topic]]
        assert times == [round(1e8 * index) for index in range(FRAMES)]
    for topic in ("/odom", "/camera/color/camera_info", "/cloud", "/path", "/cloud_map"):
        times = [time for time, _ in messages[topic]]
        assert times == sorted(times)
        assert [stamp_of(message.header) for _, message in messages[topic]] == pytest.approx([1e-9 * t for t in times])
    stamps = [stamp_of(each.header) for _, tf in messages["/tf"] for each in tf.transforms]
    assert stamps == pytest.approx([index / 10 for index in range(FRAMES) for _ in range(3)])


def test_convention_tf_tree_gives_the_pose_of_each_frame(messages: Messages, recorded: Recorded) -> None:
    for (_, tf), T_wc in zip(messages["/tf"], recorded.T_wc, strict=True):
        np.testing.assert_allclose(lookup(tf, "map", "camera_link"), camera_in_map(T_wc, AS_SEEN), atol=1e-9)
        # A point 2 m in front of the optical frame, 1 m right of its centre, is in map where the world has it.
        point = torch.tensor([1.0, 0.0, 2.0, 1.0], dtype=torch.float64)
        in_map = lookup(tf, "map", "camera_color_optical_frame") @ point.numpy()
        np.testing.assert_allclose(in_map[:3], points_in_map((T_wc @ point)[:3], AS_SEEN), atol=1e-9)


def test_odometry_agrees_with_tf_and_moves_to_the_right(messages: Messages) -> None:
    for (_, odom), (_, tf) in zip(messages["/odom"], messages["/tf"], strict=True):
        assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "camera_link")
        np.testing.assert_allclose(matrix_of(odom.pose.pose), lookup(tf, "odom", "camera_link"), atol=1e-12)
    speed = 10 * 4 * WALL / CAMERA.fx  # STEP pixels of the wall per frame, to the right
    linear = [odom.twist.twist.linear for _, odom in messages["/odom"]]
    assert linear[0].y == 0
    assert np.median([velocity.y for velocity in linear]) == pytest.approx(-speed, rel=0.05)


def test_convention_covariances_of_pose_and_twist_are_along_the_axes_of_ros(
    messages: Messages, recorded: Recorded
) -> None:
    for (_, odom), (_, tf), state in zip(messages["/odom"], messages["/tf"], recorded.states, strict=True):
        # An error along one axis of the optical frame has its variance along the same direction in odom.
        R = lookup(tf, "odom", "camera_color_optical_frame")[:3, :3]
        pose, twist = (np.reshape(each.covariance, (6, 6)) for each in (odom.pose, odom.twist))
        for rows in (slice(0, 3), slice(3, 6)):
            along_axes = R.T @ pose[rows, rows] @ R
            np.testing.assert_allclose(along_axes, state.covariance[rows, rows].numpy() + 1e-9 * np.eye(3), atol=1e-12)
        x, y, z = twist.diagonal()[:3]  # x forward, y left, z up
        np.testing.assert_allclose([y, z, x], state.twist_covariance.diagonal()[:3])
        linear = odom.twist.twist.linear
        np.testing.assert_allclose([-linear.y, -linear.z, linear.x], state.twist[:3], atol=1e-12)


def test_covariances_can_be_inverted_from_the_first_message_on(messages: Messages, recorded: Recorded) -> None:
    """The covariance of the first pose is 0, because it defines the map; filters invert it."""
    assert not recorded.states[0].covariance.any()
    for _, odom in messages["/odom"]:
        for each in (odom.pose, odom.twist):
            assert np.linalg.eigvalsh(np.reshape(each.covariance, (6, 6))).min() > 0.9e-9


def test_path_has_all_frames_at_the_end(messages: Messages, recorded: Recorded) -> None:
    trajectory = recorded.pipeline.slam.poses.trajectory()
    poses = messages["/path"][-1][1].poses
    assert [stamp_of(each.header) for each in poses] == pytest.approx(trajectory.stamps.tolist())
    written = np.array([matrix_of(each.pose) for each in poses])
    np.testing.assert_allclose(written, camera_in_map(trajectory.T_wc, AS_SEEN), atol=1e-9)
    assert [len(message.poses) for _, message in messages["/path"][:2]] == [1, 2]


def test_clouds_lie_on_the_wall_without_people(messages: Messages, recorded: Recorded) -> None:
    points, colours = points_of(messages["/cloud_map"][0][1])
    np.testing.assert_array_equal(points, points_in_map(recorded.point_map.points, AS_SEEN))
    np.testing.assert_array_equal(colours, recorded.point_map.colours)
    assert np.abs(points[:, 0] - WALL).max() < 0.02
    for _, cloud in messages["/cloud"]:
        assert cloud.header.frame_id == "camera_color_optical_frame"
        xyz, _ = points_of(cloud)
        assert len(xyz) > 1000 and np.allclose(xyz[:, 2], WALL)
    index = round(messages["/cloud"][0][0] / 1e8)
    first = Wall()[index]
    pixels = np.rint(xyz_to_pixels(points_of(messages["/cloud"][0][1])[0])).astype(int)
    expected = first.image.permute(1, 2, 0).numpy()[pixels[:, 1], pixels[:, 0]]
    np.testing.assert_array_equal(points_of(messages["/cloud"][0][1])[1], expected)


def xyz_to_pixels(points: Any) -> Any:
    return points[:, :2] / points[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]


def test_objects_have_markers_in_every_frame(messages: Messages) -> None:
    namespaces = [{marker.ns for marker in message.markers} for _, message in messages["/objects"]]
    assert all({"boxes", "names"} <= each for each in namespaces)


def test_same_run_writes_the_same_bytes(recorded: Recorded, tmp_path: Path) -> None:
    again = Recorded(tmp_path / "run.mcap")
    assert again.path.read_bytes() == recorded.path.read_bytes()


def test_poses_are_the_same_with_and_without_a_bag(recorded: Recorded) -> None:
    pipeline = Pipeline(Wall(), V3DSLAM(CAMERA, squares, CONFIG))
    pipeline()
    pipeline.flush()
    assert torch.equal(pipeline.fuse_points().points, recorded.point_map.points)
    trajectory = recorded.pipeline.slam.poses.trajectory()
    assert torch.equal(pipeline.slam.poses.trajectory().T_wc, trajectory.T_wc)


def test_correction_of_the_map_changes_map_to_odom_only(tmp_path: Path) -> None:
    """The map is moved as by a loop correction, before the last frame is written again."""
    slam = V3DSLAM(CAMERA, squares, CONFIG)
    viewer = BagViewer(tmp_path / "run.mcap", CAMERA)

    def on_frame(frame: RGBDFrame, result: FrameResult) -> None:
        if frame.index == FRAMES - 1:
            T_new_old = se3_exp(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.3, 0.0], dtype=torch.float64))
            slam.map.move_keyframes(slam.map.T_cw @ invert(T_new_old))
            viewer.show(frame, result, slam, {})

    pipeline = Pipeline(Wall(), slam, viewer=viewer)
    pipeline(on_frame)
    pipeline.flush()
    pipeline.fuse_points()
    before, after = (tf for _, tf in read_with_mcap(tmp_path / "run.mcap")["/tf"][-2:])
    np.testing.assert_allclose(lookup(after, "odom", "camera_link"), lookup(before, "odom", "camera_link"), atol=1e-9)
    moved = np.linalg.norm(lookup(after, "map", "odom")[:3, 3] - lookup(before, "map", "odom")[:3, 3])
    assert moved > 0.4
    expected = camera_in_map(invert(slam.poses.T_cw), AS_SEEN)
    np.testing.assert_allclose(lookup(after, "map", "camera_link"), expected, atol=1e-9)


def test_map_and_odom_are_level_from_the_first_frame_on_if_gravity_is_measured(tmp_path: Path) -> None:
    """The camera is pitched downwards by 30 degrees."""
    down = torch.tensor([0.0, 3**0.5 / 2, 0.5], dtype=torch.float64)

    class Pitched(Wall):
        def __getitem__(self, index: int) -> RGBDFrame:
            frame = super().__getitem__(index)
            return replace(frame, gravity=down) if index == 0 else frame

    run = Recorded(tmp_path / "run.mcap", Pitched())
    assert run.pipeline.slam.T_lw is not None
    for (_, tf), T_wc in zip(read_with_mcap(run.path)["/tf"], run.T_wc, strict=True):
        for frame in ("map", "odom"):
            gravity = lookup(tf, frame, "camera_color_optical_frame")[:3, :3] @ T_wc[:3, :3].T.numpy() @ down.numpy()
            np.testing.assert_allclose(gravity, [0, 0, -1], atol=1e-3 if frame == "odom" else 1e-9)


@pytest.mark.parametrize("lost_at", [FRAMES, 8])
def test_map_is_turned_at_the_end_if_up_is_known_only_then(lost_at: int, tmp_path: Path) -> None:
    """As by the floor, which is searched once more after the last frame. A lost camera has no pose to repeat."""
    down = torch.tensor([0.0, 3**0.5 / 2, 0.5], dtype=torch.float64)
    pipeline = Pipeline(
        Dark(lost_at), V3DSLAM(CAMERA, squares, CONFIG), viewer=BagViewer(tmp_path / "run.mcap", CAMERA)
    )
    pipeline()
    pipeline.flush()
    pipeline.slam.up_estimator.gravity = down
    fused, T_mw = pipeline.fuse_points(), pipeline.slam.T_lw
    assert T_mw is not None
    messages = read_with_mcap(tmp_path / "run.mcap")
    before, after = (tf for _, tf in messages["/tf"][-2:])
    path = messages["/path"][-1][1]
    assert stamp_of(before.transforms[0].header) < stamp_of(after.transforms[0].header) == stamp_of(path.header)
    poses = [matrix_of(each.pose) for each in path.poses]
    trajectory = pipeline.slam.poses.trajectory()
    np.testing.assert_allclose(np.array(poses), camera_in_map(trajectory.T_wc, T_mw), atol=1e-9)
    T_mo = lookup(after, "map", "odom")
    T_ol = lookup(before, "odom", "camera_link")
    np.testing.assert_allclose(T_mo @ T_ol, poses[len(messages["/tf"]) - 2], atol=1e-9)
    assert ("camera_link" in {each.child_frame_id for each in after.transforms}) == (lost_at == FRAMES)
    points, _ = points_of(messages["/cloud_map"][0][1])
    np.testing.assert_array_equal(points, points_in_map(fused.points, T_mw))
    # A player that has reached the last message applies the transforms up to its time.
    for topic, header in (("/tf", after.transforms[0].header), ("/path", path.header)):
        assert messages[topic][-1][0] == header.stamp.sec * 10**9 + header.stamp.nanosec


def test_lost_camera_has_camera_info_only_and_removes_the_markers_once(tmp_path: Path) -> None:
    run = Recorded(tmp_path / "run.mcap", Dark(from_frame=8))
    messages = read_with_mcap(run.path)
    lost = run.pipeline.slam.poses.statuses.count("lost")
    assert lost > 1
    assert len(messages["/camera/color/camera_info"]) == FRAMES
    assert len(messages["/tf"]) == len(messages["/odom"]) == FRAMES - lost
    removed = [[marker.action for marker in array.markers] == [DELETEALL] for _, array in messages["/objects"]]
    assert removed == (FRAMES - lost) * [False] + [True]
    assert messages["/objects"][-1][0] == round(1e8 * (FRAMES - lost))


def test_camera_that_is_never_found_has_camera_info_only(tmp_path: Path) -> None:
    run = Recorded(tmp_path / "run.mcap", Dark(from_frame=0))
    assert set(run.pipeline.slam.poses.statuses) == {"lost"}
    assert read_with_mcap(run.path).keys() == {"/camera/color/camera_info"}


@pytest.mark.parametrize(
    ("name", "words"),
    [("run.bag", "choose a name that ends in .mcap"), ("taken.mcap", "already exists"), ("file/run.mcap", "file")],
)
def test_unsuitable_file_is_an_error_before_the_run(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "taken.mcap").write_text("precious")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=words):
        BagViewer(tmp_path / name, CAMERA)
    assert (tmp_path / "taken.mcap").read_text() == "precious"


def test_no_file_is_left_by_a_run_without_frames(tmp_path: Path) -> None:
    run = Recorded(tmp_path / "run.mcap", Wall(broken=0))
    assert not run.path.exists()


def test_full_disk_is_a_failure_after_all_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original, count = BagFile.write, 0

    def write(self: BagFile, *arguments: Any) -> None:
        nonlocal count
        count += 1
        if count > 10:
            raise self._error(OSError(errno.ENOSPC, "No space left on device"))
        original(self, *arguments)

    monkeypatch.setattr(BagFile, "write", write)
    run = Recorded(tmp_path / "run.mcap")
    failure = run.pipeline.record.failure
    assert failure is not None and "run.mcap: the bag cannot be written (No space left on device)" in failure
    assert len(run.pipeline.slam.poses) == FRAMES and count == 11
    assert len(read_with_mcap(run.path)["/tf"]) == 2  # what was written before is readable


def test_frames_before_the_end_of_time_are_recorded_and_the_error_names_the_cause(tmp_path: Path) -> None:
    class Future(Wall):
        def __init__(self) -> None:
            super().__init__()
            self.stamps = self.stamps + 2.0**31 - 0.45

    run = Recorded(tmp_path / "run.mcap", Future())
    failure = run.pipeline.record.failure
    assert failure is not None and "ROS messages have times from 0 to 2^31 s" in failure
    assert len(run.pipeline.slam.poses) == FRAMES
    assert len(read_with_mcap(run.path)["/tf"]) == 5


def test_transform_from_map_and_objects_are_left_out_while_the_place_is_a_guess(tmp_path: Path) -> None:
    """A robot would navigate by a pose that can be wrong by metres."""
    config = load_config(None, ("segmentation.source=none", "mapping.restart_after=0.3"))
    slam = V3DSLAM(long_wall.CAMERA, config=config)
    statuses: list[TrackingStatus] = []
    pipeline = Pipeline(long_wall.Jump(), slam, viewer=BagViewer(tmp_path / "run.mcap", long_wall.CAMERA))
    pipeline(lambda _, result: statuses.append(result.status))
    pipeline.flush()
    pipeline.fuse_points()
    messages = read_with_mcap(tmp_path / "run.mcap")
    frames_of = {
        round(time / 1e8): {(each.header.frame_id, each.child_frame_id) for each in tf.transforms}
        for time, tf in messages["/tf"]
    }
    guessed = [index for index, status in enumerate(statuses) if status is TrackingStatus.DISCONNECTED]
    assert len(guessed) > 10
    for index, frames in frames_of.items():
        assert (("map", "odom") in frames) == (index not in guessed)
        assert ("odom", "camera_link") in frames
    assert {round(time / 1e8) for time, _ in messages["/cloud"]}.isdisjoint(guessed)


def test_cloud_is_that_of_the_time_of_the_colour_image() -> None:
    """The camera moved between both images, so that the wall was displaced in the cloud."""
    slam, frame = V3DSLAM(CAMERA, squares, CONFIG), Wall()[0]
    result = slam(frame)
    T_dc = se3_exp(torch.tensor([0.05, -0.02, 0.1, 0.01, 0.02, -0.03], dtype=torch.float64))
    points = []
    for each in (result, replace(result, T_dc=T_dc)):
        clouds = [message for topic, message in RunMessages(CAMERA).of_frame(frame, each, slam) if topic == "/cloud"]
        points.append(torch.from_numpy(points_of(clouds[0])[0]))
    np.testing.assert_allclose(points[1], transform_points(invert(T_dc), points[0]), atol=1e-5)
