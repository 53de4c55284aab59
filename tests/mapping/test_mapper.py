"""Keyframe decision of the mapper, and the state that it keeps from frame to frame."""

from __future__ import annotations

import copy

import torch
from helpers.sparse_maps import CAMERA, EYE, features
from helpers.waiting import steps_until

from v3d_torch.config.loading import load_config
from v3d_torch.mapping.covisibility import covisibility_edges
from v3d_torch.mapping.mapper import Mapper
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.types import FramePose, RGBDFrame, TrackingStatus

TRACKED, ODOMETRY, LOST = TrackingStatus.TRACKED, TrackingStatus.ODOMETRY, TrackingStatus.LOST


class FrameFeeder:
    """Passes frames to a mapper, at 30 Hz; frames differ in their number of matched landmarks and their status.

    Args:
        settings: Mapping configuration.
    """

    def __init__(self, **settings: int | float) -> None:
        overrides = [f"mapping.{key}={value}" for key, value in settings.items()]
        config = load_config(overrides=[*overrides, "mapping.bundle_keyframes=0"])
        self.mapper = Mapper(config, CAMERA, SparseMap.empty(config, CAMERA))
        self.index, self.step, self.stamp = -1, 1, -1 / 30

    def __call__(self, matched: int, status: TrackingStatus = TRACKED, feature_count: int = 400) -> bool:
        """Process the next frame; returns whether it became a keyframe."""
        self.index += self.step
        self.stamp += 1 / 30
        image, depth = torch.zeros(3, 480, 640, dtype=torch.uint8), torch.zeros(1, 480, 640)
        landmarks = torch.full((feature_count,), -1)
        landmarks[:matched] = torch.arange(matched)
        frame = RGBDFrame(self.index, self.stamp, image, depth)
        keyframes = self.mapper.map.keyframes
        reference = keyframes[-1] if keyframes else None
        return self.mapper(frame, features(feature_count), FramePose(status, EYE, landmarks), reference) is not None

    def until_keyframes(self, count: int, matched: int, status: TrackingStatus = TRACKED) -> None:
        """Process equal frames until the map has a number of keyframes."""
        for _ in steps_until(lambda: len(self.mapper.map.keyframes) >= count, 100, f"there are {count} keyframes"):
            self(matched, status)


def test_keyframe_is_inserted_when_tracking_gets_weak() -> None:
    feed = FrameFeeder(max_keyframe_interval=100, min_tracked=100, min_tracked_ratio=0.7)
    assert feed(0, LOST)
    assert [feed(matched) for matched in (300, 290, 211, 209)] == [False, False, False, True]
    assert [feed(matched) for matched in (150, 110, 104)] == [False, False, True]  # below 0.7 of 150
    assert [feed(matched) for matched in (120, 110, 101, 99)] == [False, False, False, True]  # below the minimum count


def test_keyframes_keep_a_distance_where_images_show_few_landmarks() -> None:
    feed = FrameFeeder(max_keyframe_interval=100, min_tracked=100, min_tracked_ratio=0.7)
    assert feed(0, LOST, feature_count=100)
    inserted = [feed(60, feature_count=100) for _ in range(12)]
    assert [index for index, is_keyframe in enumerate(inserted, 1) if is_keyframe] == [4, 8, 12]


def test_frame_without_new_landmarks_is_a_keyframe_only_after_the_maximum_interval() -> None:
    feed = FrameFeeder(max_keyframe_interval=20, min_tracked=100, min_tracked_ratio=0.7)
    assert feed(0, LOST) and not feed(300)
    inserted = [feed(60, feature_count=79) for _ in range(20)]  # 19 features without a landmark
    assert [index for index, is_keyframe in enumerate(inserted, 2) if is_keyframe] == [20]
    feed(300)
    assert feed(60, feature_count=80)


def test_keyframe_is_inserted_after_the_maximum_interval() -> None:
    feed = FrameFeeder(max_keyframe_interval=5)
    inserted = [feed(0, LOST)] + [feed(300) for _ in range(15)]
    assert [index for index, is_keyframe in enumerate(inserted) if is_keyframe] == [0, 5, 10, 15]
    feed.index = 0  # the camera was started again
    assert [feed(300) for _ in range(10)] == 2 * [False, False, False, False, True]
    feed.step = 0  # the frames have no index
    assert [feed(300) for _ in range(10)] == 2 * [False, False, False, False, True]
    feed.step = 3  # two of three frames are dropped
    assert [feed(300) for _ in range(6)] == 3 * [False, True]


def test_map_continues_by_odometry_after_the_delay_and_stays_connected() -> None:
    feed = FrameFeeder(map_by_odometry_after=0.3, max_keyframe_interval=1000)
    assert feed(0, LOST)
    for _ in range(2):  # a tracked frame resets the delay
        assert [feed(0, ODOMETRY) for _ in range(8)] == [False] * 8
        assert not feed(300)
    inserted = [feed(0, ODOMETRY) for _ in range(20)]
    assert inserted.index(True) in (9, 10)  # 0.3 s at 30 Hz
    assert not feed.mapper.map.keyframes[-1].is_disconnected


def test_map_does_not_start_with_too_few_features() -> None:
    feed = FrameFeeder(min_tracked=100)
    assert not feed(0, LOST, feature_count=99)
    assert feed(0, LOST, feature_count=100)


def test_lost_camera_starts_a_disconnected_part_of_the_map_after_the_delay() -> None:
    feed = FrameFeeder(restart_after=0.5)
    assert feed(0, LOST)
    inserted = [feed(0, LOST) for _ in range(20)]
    assert inserted.index(True) in (15, 16)  # half a second at 30 Hz
    first, second = feed.mapper.map.keyframes[:2]
    assert not first.is_disconnected and second.is_disconnected
    feed(5)
    assert feed.mapper.map.keyframes[-1].is_disconnected  # because its reference keyframe is


def test_camera_that_is_lost_again_starts_another_part_of_the_map() -> None:
    feed = FrameFeeder(restart_after=0.5, max_keyframe_interval=5)
    assert feed(0, LOST)
    feed.until_keyframes(2, 0, LOST)
    feed.until_keyframes(3, 300)
    feed.until_keyframes(4, 0, LOST)
    feed.until_keyframes(5, 300)
    assert [keyframe.part for keyframe in feed.mapper.map.keyframes] == [0, 1, 1, 2, 2]
    assert covisibility_edges(feed.mapper.map, 1000).tolist() == [[1, 2], [3, 4]]


def test_part_that_a_lost_camera_starts_after_parts_were_joined_has_an_unused_id() -> None:
    feed = FrameFeeder(restart_after=0.5)
    assert feed(0, LOST)
    feed.until_keyframes(3, 0, LOST)
    feed.mapper.map.join_parts(0, 1)
    feed.until_keyframes(4, 0, LOST)
    assert [keyframe.part for keyframe in feed.mapper.map.keyframes] == [0, 0, 2, 3]


def test_restart_delay_begins_when_a_covered_camera_is_uncovered() -> None:
    feed = FrameFeeder(restart_after=0.5)
    assert feed(0, LOST)
    assert [feed(0, LOST, feature_count=20) for _ in range(40)] == [False] * 40
    inserted = [feed(0, LOST) for _ in range(20)]
    assert inserted.index(True) in (15, 16)


def test_restart_delay_is_reset_when_the_camera_is_tracked() -> None:
    feed = FrameFeeder(restart_after=0.5, max_keyframe_interval=1000)
    assert feed(0, LOST)
    for _ in range(3):
        assert [feed(0, LOST) for _ in range(10)] == [False] * 10
        assert not feed(300)


def continue_from(original: FrameFeeder, *, with_state: bool, **settings: int | float) -> FrameFeeder:
    """A new mapper with a copy of the map of another one, with or without the state of that mapper."""
    feeder = FrameFeeder(**settings)
    feeder.mapper.map.load_state_dict(copy.deepcopy(original.mapper.map.state_dict()))
    if with_state:
        feeder.mapper.load_state_dict(original.mapper.state_dict())
    feeder.index, feeder.stamp = original.index, original.stamp
    return feeder


def test_mapper_with_the_state_of_another_mapper_restarts_at_the_same_frame() -> None:
    original = FrameFeeder(restart_after=0.5)
    assert original(0, LOST) and not original(300)
    assert not any(original(0, LOST) for _ in range(6))
    restored = continue_from(original, with_state=True, restart_after=0.5)
    without_state = continue_from(original, with_state=False, restart_after=0.5)
    inserted = [[feeder(0, LOST) for _ in range(12)] for feeder in (original, restored, without_state)]
    assert inserted[0] == inserted[1] and any(inserted[0])
    assert not any(inserted[2])


def test_mapper_with_the_state_of_another_mapper_has_the_same_interval() -> None:
    original = FrameFeeder(max_keyframe_interval=5)
    assert original(0, LOST) and not any(original(300) for _ in range(3))
    restored = continue_from(original, with_state=True, max_keyframe_interval=5)
    assert [[feeder(300), feeder(300)] for feeder in (original, restored)] == 2 * [[False, True]]


def test_mapper_with_the_state_of_another_mapper_has_the_same_tracking_threshold() -> None:
    original = FrameFeeder(min_tracked_ratio=0.7)
    assert original(0, LOST) and not original(300)
    restored = continue_from(original, with_state=True, min_tracked_ratio=0.7)
    without_state = continue_from(original, with_state=False, min_tracked_ratio=0.7)
    assert [feeder(209) for feeder in (original, restored, without_state)] == [True, True, False]
