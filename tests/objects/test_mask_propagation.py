"""Masks of frames without segmentation follow boards that move in front of a wall."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.boards import CAMERA, CHAIR, CLOUDS, DOG, HERE, PERSON, Board, BoardTracker, render
from helpers.object_scenes import ObjectStage
from torch import Tensor

from v3d_torch import V3DSLAM, RGBDFrame, load_config, load_sequence
from v3d_torch.config import Config, ObjectsConfig
from v3d_torch.geometry.se3 import invert
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.frame_objects import MotionState
from v3d_torch.objects.mask_propagation import propagate_instances
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.segmentation.coco import UNLABELLED
from v3d_torch.types import Instances

SPEED = 1.2
"""Speed of the walking board, m/s."""

STANDING = Board(0.8, z=2.5)
FURNITURE = Board(-0.9, z=3.0, label=CHAIR)


def walk(rate: float = 30.0, label: int = PERSON, frames: int = 6) -> BoardTracker:
    """Track a walking board, a standing one, and furniture."""
    track_boards = BoardTracker(rate)
    for i in range(frames):
        track_boards(Board(-0.6 + SPEED * i / rate, label=label), STANDING, FURNITURE)
    return track_boards


def propagate(track_boards: BoardTracker, boards: list[Board], T_wc: Tensor = HERE) -> tuple[Instances, Instances]:
    """Return the propagated and the true instances of the next frame."""
    depth, truth = render(boards, T_wc)
    view = DepthView((track_boards.frame + 1) / track_boards.rate, depth, invert(T_wc))
    return propagate_instances(track_boards.tracker.tracks, view, CAMERA, CLOUDS), truth


def intersection_over_union(a: Tensor, b: Tensor) -> Tensor:
    return (a & b).flatten(1).sum(dim=1) / (a | b).flatten(1).sum(dim=1)


@pytest.mark.parametrize("rate", [10.0, 30.0])
def test_masks_follow_a_moving_and_a_standing_object_and_furniture(rate: float) -> None:
    track_boards = walk(rate)
    found, truth = propagate(track_boards, [Board(-0.6 + SPEED * 6 / rate), STANDING, FURNITURE])
    assert found.labels.tolist() == [PERSON, PERSON, CHAIR]
    assert found.track_ids is not None and found.track_ids.tolist() == [1, 2, 3]
    assert found.scores.tolist() == [0.0] * 3 and found.boxes.shape == (3, 4)
    assert float(intersection_over_union(found.masks, truth.masks).min()) > 0.85


def test_masks_follow_the_motion_of_the_camera() -> None:
    T_wc = HERE.clone()
    T_wc[0, 3] = 0.2
    found, truth = propagate(walk(), [Board(-0.6 + SPEED * 6 / 30), STANDING], T_wc)
    assert float(intersection_over_union(found.masks, truth.masks).min()) > 0.85


def test_object_that_has_left_is_missed_and_starts_no_track() -> None:
    track_boards = walk()
    found, truth = propagate(track_boards, [STANDING])
    assert found.labels.tolist() == [PERSON]
    assert float(intersection_over_union(found.masks, truth.masks).min()) > 0.85


def test_missed_and_unlabelled_objects_are_not_propagated() -> None:
    track_boards = walk()
    track_boards(Board(-0.36, detected=False), STANDING)
    found, _ = propagate(track_boards, [Board(-0.32), STANDING])
    assert found.labels.tolist() == [PERSON]
    found, _ = propagate(walk(label=UNLABELLED), [Board(-0.36), STANDING])
    assert found.labels.tolist() == [PERSON]


@pytest.mark.parametrize("z", [7.0, 0.0], ids=["too far", "no depth"])
@pytest.mark.parametrize("segmented", [{0, 2, 4, 6}, {0, 1, 3, 6}], ids=["every second frame", "in some frames"])
def test_person_without_centroid_stays_masked_in_frames_without_segmentation(z: float, segmented: set[int]) -> None:
    stage = ObjectStage(ObjectsConfig(clouds=CLOUDS), CAMERA)
    for frame in range(8):
        depth, instances = render([Board(-0.4 + 0.02 * frame)])
        depth[:, instances.masks[0]] = z
        result = stage(frame / 30, instances if frame in segmented else None, depth, HERE)
        assert [(obj.id, obj.missed, obj.motion_state) for obj in result.objects] == [(1, False, MotionState.UNKNOWN)]
        assert not result.static_mask[instances.masks[0]].any()


def test_person_without_centroid_stays_masked_in_a_frame_in_which_the_network_misses_it() -> None:
    stage = ObjectStage(ObjectsConfig(clouds=CLOUDS), CAMERA)
    for frame in range(4):
        depth, instances = render([Board(-0.4 + 0.02 * frame)])
        depth[:, instances.masks[0]] = 7.0
        found = Instances.empty(CAMERA.height, CAMERA.width) if frame == 2 else instances
        result = stage(frame / 30, found, depth, HERE)
        assert [(obj.id, obj.missed) for obj in result.objects] == [(1, frame == 2)]
        assert not result.static_mask[instances.masks[0]].any()


def test_wrong_first_class_is_corrected_with_frames_without_segmentation() -> None:
    stage = ObjectStage(ObjectsConfig(clouds=CLOUDS), CAMERA)
    for frame in range(6):
        depth, instances = render([Board(-0.4 + 0.02 * frame, label=DOG if frame == 0 else PERSON)])
        result = stage(frame / 30, instances if frame % 2 == 0 else None, depth, HERE)
        assert [(obj.id, obj.label) for obj in result.objects] == [(1, PERSON if frame >= 4 else DOG)]


def test_furniture_votes_in_frames_with_and_without_segmentation() -> None:
    stage = ObjectStage(ObjectsConfig(clouds=CLOUDS), CAMERA)
    for frame in range(8):
        boards = [Board(-0.4 + 0.1 * frame), Board(-1.3, z=3.0, label=CHAIR), Board(1.3, z=3.0, label=CHAIR)]
        depth, instances = render(boards)
        result = stage(frame / 10, instances if frame % 2 == 0 else None, depth, HERE)
        assert [(obj.id, obj.label) for obj in result.objects] == [(1, PERSON), (2, CHAIR), (3, CHAIR)]
        assert result.vote_pairs == ([(2, 1), (3, 1)] if frame > 0 else [])


def test_propagated_instances_continue_their_tracks_wherever_they_are() -> None:
    track_boards = walk()
    depth, truth = render([Board(-0.6 + SPEED * 6 / 30), STANDING, FURNITURE])
    swapped = replace(truth, track_ids=torch.tensor([2, 1, 3]))
    masks = {track.id: track.mask for track in track_boards.track(depth, swapped, 6 / 30)}
    assert list(masks) == [1, 2, 3]
    assert torch.equal(masks[2], truth.masks[0]) and torch.equal(masks[1], truth.masks[1])


def test_instances_beside_propagated_ones_are_matched_to_the_other_tracks() -> None:
    track_boards = walk()
    depth, truth = render([Board(-0.6 + SPEED * 6 / 30), STANDING, FURNITURE])
    tracks = track_boards.track(depth, replace(truth, track_ids=torch.tensor([0, 2, 0])), 6 / 30)
    assert [(track.id, track.missed) for track in tracks] == [(1, False), (2, False), (3, False)]
    assert all(torch.equal(track.mask, mask) for track, mask in zip(tracks, truth.masks, strict=True))


def test_no_tracks_give_no_instances() -> None:
    found, _ = propagate(BoardTracker(), [Board(0.0)])
    assert len(found) == 0 and found.masks.shape == (0, CAMERA.height, CAMERA.width)


def test_realtime_segments_every_second_frame() -> None:
    assert load_config("realtime").segmentation.interval == 2 and Config().segmentation.interval == 1
    sequence, segmented = load_sequence("demo"), []

    def segment(frame: RGBDFrame) -> Instances:
        segmented.append(frame.index)
        return NoSegmentation()(frame)

    slam = V3DSLAM(sequence.camera, segment, load_config("realtime"))
    with torch.inference_mode():
        for index in range(5):
            slam(sequence[index])
    assert segmented == [0, 2, 4]
