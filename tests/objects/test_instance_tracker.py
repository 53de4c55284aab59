"""Object ids over frames and prediction of missed objects, on boards that move in front of a wall."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from helpers.boards import CAMERA, CHAIR, CLOUDS, DOG, HERE, PERSON, Board, BoardTracker, render, render_turned
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import TrackerConfig
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.appearance import HISTOGRAM_SIZE
from v3d_torch.objects.instance_clouds import InstanceBackProjector
from v3d_torch.objects.track import Detection3D, Track, predict_clouds
from v3d_torch.segmentation.coco import UNLABELLED
from v3d_torch.types import Instances


def track_thrice(track_boards: BoardTracker, *boards: Board) -> None:
    """Process the same boards in three frames."""
    for _ in range(3):
        track_boards(*boards)


def at(tracks: list[Track], board: Board) -> Track:
    """Return the only detected track whose centroid is at the centre of the board."""
    position = torch.tensor([board.x, board.y, board.z], dtype=torch.float64)
    found = [track for track in tracks if not track.missed and float((track.newest.centroid - position).norm()) < 0.03]
    assert len(found) == 1
    return found[0]


def mask_centre(mask: Tensor) -> Tensor:
    """Return the mean (column, row) of a mask."""
    return mask.nonzero().double().mean(dim=0).flip(0)


def test_first_objects_have_ids_in_the_order_of_the_instances() -> None:
    boards = [Board(0.0), Board(-0.8), Board(0.7)]
    tracks = BoardTracker()(*boards)
    assert [at(tracks, board).id for board in boards] == [1, 2, 3]


@pytest.mark.parametrize("rate", [5.0, 30.0])
def test_ids_are_kept_under_motion(rate: float) -> None:
    """One board moves at 1 m/s to the right, one at 1 m/s away, and one is static."""
    track_boards = BoardTracker(rate)
    for frame in range(int(rate)):
        t = frame / rate
        boards = [Board(-0.5 + t), Board(-1.0, 2.0 + t, y=-0.3, height=0.5), Board(1.2, 2.5)]
        tracks = track_boards(*boards)
        assert [at(tracks, board).id for board in boards] == [1, 2, 3]
    assert [track.id for track in tracks] == [1, 2, 3]


def test_ids_are_kept_when_the_order_of_the_instances_changes() -> None:
    track_boards = BoardTracker()
    boards = [Board(0.0), Board(-0.8), Board(0.7)]
    for order in ([0, 1, 2], [2, 0, 1], [1, 0, 2], [2, 1, 0]):
        tracks = track_boards(*(boards[i] for i in order))
        assert [at(tracks, board).id for board in boards] == [1, 2, 3]
        assert [track.id for track in tracks] == [1, 2, 3]


def test_ids_are_kept_under_flickering_class_and_label_is_the_most_frequent() -> None:
    track_boards = BoardTracker()
    for label in (PERSON, DOG, PERSON, CHAIR, PERSON, DOG, PERSON):
        tracks = track_boards(Board(0.0, label=label), Board(0.7, label=CHAIR))
        assert at(tracks, Board(0.0)).id == 1
        assert at(tracks, Board(0.7)).id == 2
    assert tracks[0].label == PERSON
    assert tracks[0].labels == {PERSON: 4, DOG: 2, CHAIR: 1}


@pytest.mark.parametrize("score", [0.9, 0.0])
def test_most_frequent_class_of_masks_with_or_without_scores(score: float) -> None:
    track_boards = BoardTracker()
    for frame, label in enumerate((DOG, PERSON, PERSON)):
        depth, instances = render([Board(0.0, label=label)])
        (track,) = track_boards.track(depth, replace(instances, scores=torch.tensor([score])), frame / 30)
    assert (track.label, track.labels) == (PERSON, {DOG: 1, PERSON: 2})


@pytest.mark.parametrize("visible", [slice(40), slice(60)], ids=["upper part", "all but the feet"])
def test_second_detection_of_an_object_starts_no_track(visible: slice) -> None:
    """The network finds a part of a person, and in some frames the whole person as well."""
    track_boards = BoardTracker()
    depth, whole = render([Board(0.0, height=1.2)])
    part = replace(whole, masks=torch.zeros_like(whole.masks))
    part.masks[:, visible] = whole.masks[:, visible]
    both = part.concatenate(whole)
    for frame in range(6):
        tracks = track_boards.track(depth, both if frame % 2 else part, frame / 30)
        assert [track.id for track in tracks] == [1]


def test_instance_of_two_pixels_starts_no_track() -> None:
    """Such as the rest of a person who goes behind another, which became a person of its own."""
    track_boards = BoardTracker()
    depth, instances = render([Board(0.0), Board(0.7)])
    instances.masks[1] = False
    instances.masks[1, 41, 41:43] = True
    for frame in range(3):
        tracks = track_boards.track(depth, instances, frame / 30)
        assert [track.id for track in tracks] == [1]


def test_part_and_whole_that_appear_in_the_same_frame_are_one_object() -> None:
    """The part has the higher score, so that the suppression of duplicates keeps both."""
    track_boards = BoardTracker()
    depth, whole = render([Board(0.0, height=1.2)])
    part = replace(whole, masks=torch.zeros_like(whole.masks))
    part.masks[:, :60] = whole.masks[:, :60]
    for frame in range(3):
        tracks = track_boards.track(depth, part.concatenate(whole), frame / 30)
        assert [track.id for track in tracks] == [1]


@pytest.mark.parametrize("label", [PERSON, UNLABELLED])
def test_hidden_object_gets_its_id_back_with_or_without_a_class(label: int) -> None:
    track_boards, board = BoardTracker(), Board(0.0, label=label)
    curtain = Board(0.0, z=1.5, width=2.0, height=2.0, detected=False)
    for frame in range(40):
        depth, instances = render([board if not 8 <= frame < 36 else curtain])
        tracks = track_boards.track(depth, instances, frame / 30)
        for track in tracks:
            track.motion.mark_dynamic(frame / 30)
    assert [track.id for track in tracks] == [1]


def test_lost_object_gets_its_id_back_at_its_place_although_another_one_is_missed_nearby() -> None:
    """One is hidden for 0.7 s, the other one for 0.3 s; then the first one is where it was."""
    track_boards, left, right = BoardTracker(), Board(-0.25), Board(0.25)
    curtain = Board(0.0, z=1.5, width=2.0, height=2.0, detected=False)
    covered = Board(-1.0, z=1.5, width=1.5, height=2.0, detected=False)
    for frame in range(28):
        boards = [left, right] if frame < 6 else [covered, right] if frame < 18 else [curtain] if frame < 27 else [left]
        depth, instances = render(boards)
        tracks = track_boards.track(depth, instances, frame / 30)
    assert at(tracks, left).id == 1


@pytest.mark.parametrize("compared", [True, False])
def test_colours_decide_between_two_people_who_return(compared: bool) -> None:
    """A curtain hides both for a second; then each one is at the place of the other one."""
    track_boards = BoardTracker(compare_appearance=compared)
    colours = torch.eye(HISTOGRAM_SIZE)[:2]
    left, right = Board(-0.3), Board(0.3)
    curtain = Board(0.0, z=1.5, width=2.0, height=2.0, detected=False)
    for boards, first, last in (((left, right), 0, 6), ((curtain,), 6, 36), ((right, left), 36, 37)):
        depth, instances = render(list(boards))
        for frame in range(first, last):
            tracks = track_boards.track(depth, instances, frame / 30, appearance=colours[: len(instances)])
    assert [at(tracks, board).id for board in (right, left)] == ([1, 2] if compared else [2, 1])


def test_appearance_of_any_length_can_be_unknown_for_one_instance() -> None:
    track_boards = BoardTracker()
    depth, instances = render([Board(-0.3), Board(0.3)])
    appearance = torch.stack([torch.full((16,), torch.nan), torch.eye(16)[0]])
    for frame in range(3):
        tracks = track_boards.track(depth, instances, frame / 30, appearance=appearance)
    assert [track.id for track in tracks] == [1, 2]
    assert tracks[0].appearance is None and torch.equal(tracks[1].appearance, torch.eye(16)[0])


def test_id_is_kept_over_a_gap_in_time_before_a_frame_in_which_the_object_is_missed() -> None:
    """After 2 s in which nothing was observed the place is empty; the object is found in the frame after that."""
    track_boards, colours = BoardTracker(), torch.eye(HISTOGRAM_SIZE)[:1]
    stamps = [*(frame / 30 for frame in range(6)), 2.2, 2.2 + 1 / 30]
    boards = [*[Board(-0.4)] * 6, Board(0.1, detected=False), Board(0.1)]
    for stamp, board in zip(stamps, boards, strict=True):
        depth, instances = render([board])
        tracks = track_boards.track(depth, instances, stamp, appearance=colours[: len(instances)])
    assert [track.id for track in tracks] == [1]


def test_id_is_kept_after_a_second_in_which_the_place_of_the_object_was_empty() -> None:
    """The object has walked out of view and comes back beside its last place."""
    track_boards, colours = BoardTracker(), torch.eye(HISTOGRAM_SIZE)[:1]
    for frame in range(37):
        depth, instances = render([Board(-0.4)] if frame < 6 else [Board(-0.2)] if frame == 36 else [])
        tracks = track_boards.track(depth, instances, frame / 30, appearance=colours[: len(instances)])
    assert [track.id for track in tracks] == [1]


def test_class_decides_between_two_equally_distant_instances() -> None:
    """Between two frames a dog and a chair moved by half of their distance."""
    track_boards = BoardTracker(5.0)
    track_boards(Board(-0.4, label=DOG), Board(0.4, label=CHAIR))
    tracks = track_boards(Board(0.0, y=-0.45, label=CHAIR), Board(0.0, y=0.45, label=DOG))
    assert at(tracks, Board(0.0, y=-0.45)).label == CHAIR
    assert at(tracks, Board(0.0, y=-0.45)).id == 2
    assert at(tracks, Board(0.0, y=0.45)).id == 1


def test_mask_decides_between_two_similarly_distant_instances() -> None:
    """One instance lies beside the old position without overlap, another 2 cm farther below with half overlap."""
    track_boards = BoardTracker()
    track_boards(Board(0.0, width=0.2))
    beside, below = Board(0.17, width=0.2), Board(0.0, y=0.19, width=0.2)
    tracks = track_boards(beside, below)
    x, y = next(track for track in tracks if track.id == 1).newest.centroid[:2].tolist()
    assert abs(x) < 0.04
    assert abs(y - 0.19) < 0.04


@pytest.mark.parametrize("rate", [10.0, 30.0])
def test_ids_are_kept_when_two_objects_cross(rate: float) -> None:
    """Two boards of one class at 1 m/s in opposite directions, 0.6 m apart in depth; one is occluded in between."""
    track_boards = BoardTracker(rate)
    for frame in range(int(1.6 * rate) + 1):
        x = frame / rate - 0.8
        near, far = Board(x, 2.0), Board(-x, 2.6)
        tracks = track_boards(near, far)
        assert at(tracks, near).id == 1
    assert at(tracks, far).id == 2


def test_ids_of_static_objects_are_kept_under_camera_motion() -> None:
    """1.2 m/s at 5 Hz: in the image, the boards move by half of their distance per frame."""
    track_boards = BoardTracker(5.0)
    boards = [Board(-0.6), Board(-0.1), Board(0.4)]
    for frame in range(4):
        T_wc = HERE.clone()
        T_wc[0, 3] = -0.36 + 0.24 * frame
        T_wc[2, 3] = -0.1 * frame
        tracks = track_boards(*boards, T_wc=T_wc)
        for i, board in enumerate(boards, start=1):
            found = [track for track in tracks if abs(float(track.newest.centroid[0]) - board.x) < 0.1]
            assert [track.id for track in found] == [i]


def test_instance_beyond_the_gate_is_a_new_object() -> None:
    track_boards = BoardTracker()
    track_boards(Board(-0.5))
    tracks = track_boards(Board(0.5))
    assert [(track.id, track.missed) for track in tracks] == [(1, True), (2, False)]


@pytest.mark.parametrize(("rate", "reach"), [(30.0, 0.1 + 1.5 / 30), (5.0, 0.1 + 1.5 / 5)])
def test_gate_is_max_jump_plus_max_speed_times_elapsed_time(rate: float, reach: float) -> None:
    """The boards are so narrow that their masks do not overlap."""
    for step, kept in ((reach - 0.02, True), (reach + 0.02, False)):
        track_boards = BoardTracker(rate, max_speed=1.5, max_jump=0.1)
        track_boards(Board(0.0, width=0.1))
        assert at(track_boards(Board(step, width=0.1)), Board(step)).id == (1 if kept else 2)


def test_instance_of_another_class_continues_only_an_overlapping_object() -> None:
    for step, kept in ((0.04, True), (0.5, False)):
        track_boards = BoardTracker()
        track_boards(Board(0.0, label=CHAIR))
        assert at(track_boards(Board(step, label=DOG)), Board(step)).id == (1 if kept else 2)


def test_missed_object_and_new_object_do_not_change_a_third_id() -> None:
    """The second moves by 0.35 m; the first is missed, and a new one is far away."""
    track_boards = BoardTracker(5.0)
    track_boards(Board(-0.4, 2.0), Board(0.4, 2.0))
    new_position, new = Board(0.05, 2.0), Board(1.1, 3.2)
    tracks = track_boards(Board(-0.4, 2.0, detected=False), new_position, new)
    assert at(tracks, new_position).id == 2
    assert at(tracks, new).id == 3


def test_ids_in_a_row_do_not_shift_when_one_end_is_missed() -> None:
    """Books on a shelf, 0.2 m apart: all in the middle keep their positions."""
    track_boards = BoardTracker()
    shelf = [Board(0.2 * i - 0.5, width=0.15, height=0.3, label=CHAIR) for i in range(6)]
    track_boards(*shelf[:5])
    tracks = track_boards(*shelf[1:])
    assert [at(tracks, book).id for book in shelf[1:]] == [2, 3, 4, 5, 6]


def test_velocity_of_constant_motion_is_estimated() -> None:
    track_boards = BoardTracker()
    for frame in range(20):
        tracks = track_boards(Board(-0.5 + 0.03 * frame, 2.0 + 0.01 * frame))
    expected = torch.tensor([0.9, 0.0, 0.3], dtype=torch.float64)
    assert float((tracks[0].velocity - expected).norm()) < 0.2


def test_predicted_cloud_moves_like_the_predicted_state() -> None:
    """Also after half a second, when the velocity decays."""
    track_boards = BoardTracker()
    for frame in range(20):
        (track,) = track_boards(Board(-0.5 + 0.03 * frame))
    start = track.predict_state(track.newest.stamp).position
    for seconds in (0.0, 0.3, 2.0):
        stamp = track.newest.stamp + seconds
        (cloud,) = predict_clouds([track], [track.predict_state(stamp)], torch.eye(4, dtype=torch.float64))
        motion = (cloud - track.newest.cloud).mean(dim=0)
        torch.testing.assert_close(motion, track.predict_state(stamp).position - start)


def test_cloud_of_the_last_detection_moves_with_the_object() -> None:
    track_boards = BoardTracker()
    (track,) = track_boards(Board(-0.5))
    assert track.predict_previous_cloud() is None
    for frame in range(1, 20):
        track_boards(Board(-0.5 + 0.03 * frame))
    cloud = track.predict_previous_cloud()
    assert cloud is not None
    assert float((cloud.mean(dim=0) - track.newest.cloud.mean(dim=0)).norm()) < 0.01


def test_clouds_are_predicted_together_in_the_camera_frame() -> None:
    track_boards = BoardTracker()
    for frame in range(10):
        tracks = track_boards(Board(-0.5 + 0.03 * frame), Board(0.6, width=0.2))
    T_cw = se3_exp(torch.tensor([0.1, 0.2, 0.3, 0.1, -0.2, 0.3], dtype=torch.float64))
    stamp = tracks[0].newest.stamp + 0.2
    states = [track.predict_state(stamp) for track in tracks]
    clouds = predict_clouds(tracks, states, T_cw)
    assert len(tracks) == 2
    for track, state, cloud in zip(tracks, states, clouds, strict=True):
        world = track.newest.cloud.to(torch.float64) + track.motion_to(state)
        torch.testing.assert_close(cloud, torch.stack([T_cw[:3, :3] @ point + T_cw[:3, 3] for point in world]))
    assert predict_clouds([], [], T_cw) == []


def test_partial_view_changes_the_prediction_less() -> None:
    """Either the left half of a static board is visible, or the board has half the size: the same centroid."""
    half = Board(-0.1, width=0.2)
    grown, cut = BoardTracker(10.0), BoardTracker(10.0)
    for _ in range(5):
        cut(Board(0.0))
        grown(Board(0.0, width=0.2))
    (same,), (part,) = grown(half), cut(half)
    assert float(same.predict_state(0.5).position[0]) < -0.05
    assert abs(float(part.predict_state(0.5).position[0])) < 0.5 * abs(float(same.predict_state(0.5).position[0]))
    assert abs(float(part.velocity[0])) < 0.5 * abs(float(same.velocity[0]))


def test_overlapping_mask_keeps_id_despite_centroid_jump() -> None:
    """The visible part of the board grows: the centroid jumps beyond the gate, but the masks overlap."""
    track_boards = BoardTracker(max_jump=0.05, max_speed=0.3)
    track_boards(Board(0.0, y=-0.1, height=0.6))
    (track,) = track_boards(Board(0.0, y=0.04, height=0.8))
    assert track.id == 1
    assert (track.newest.centroid - track.detections[0].centroid).norm() > 0.05 + 0.3 / 30


def test_predicted_mask_keeps_id_of_a_fast_walker() -> None:
    """2 m/s at 5 Hz: the next mask does not overlap the last one, and the class has changed."""
    track_boards = BoardTracker(5.0)
    for frame in range(5):
        track_boards(Board(-1.0 + 0.4 * frame, 2.5, width=0.3))
    (track,) = track_boards(Board(1.0, 2.5, width=0.3, label=DOG))
    assert track.id == 1


def test_turning_camera_keeps_ids_of_flickering_classes() -> None:
    """0.25 rad per frame: all masks move by more than their width."""
    track_boards = BoardTracker(10.0)
    boards = [Board(-0.4, 3.0, width=0.3), Board(0.4, 3.0, width=0.3)]
    depth, instances = render(boards)
    back_project = InstanceBackProjector(CLOUDS, CAMERA)
    track_boards.tracker(0.0, instances, back_project(depth, instances), depth, HERE)
    T_wc = se3_exp(torch.tensor([0.0, 0.0, 0.0, 0.0, -0.25, 0.0], dtype=torch.float64))
    depth, instances = render_turned(boards, T_wc)
    instances = replace(instances, labels=torch.tensor([DOG, CHAIR]))
    tracks = track_boards.tracker(0.1, instances, back_project(depth, instances), depth, T_wc)
    assert [(track.id, track.missed) for track in tracks] == [(1, False), (2, False)]


@pytest.mark.parametrize("there", [True, False])
def test_visible_missed_object_is_not_matched_to_a_nearby_instance(there: bool) -> None:
    """The new board is within the gate and of the same class, but the first is still visible at its position."""
    first, other = Board(-0.3), Board(0.22)
    track_boards = BoardTracker(5.0)
    track_thrice(track_boards, first)
    tracks = track_boards(*([replace(first, detected=False)] if there else []), other)
    assert at(tracks, other).id == (2 if there else 1)
    assert [track.id for track in tracks if track.missed] == ([1] if there else [])


def test_object_emerging_from_occlusion_keeps_its_id() -> None:
    """First a part beside a cabinet, then all: the centroid jumps beyond the gate, but the mask covers the part."""
    part, cabinet = Board(-0.9, width=0.4, height=2.0), Board(0.3, z=1.9, width=2.0, height=2.0, detected=False)
    whole = Board(0.1, width=2.4, height=2.0)
    track_boards = BoardTracker()
    track_thrice(track_boards, part, cabinet)
    assert [(track.id, track.missed) for track in track_boards(whole)] == [(1, False)]


@pytest.mark.parametrize("rate", [5.0, 30.0])
def test_missed_object_is_predicted_with_its_mask_and_then_removed(rate: float) -> None:
    track_boards = BoardTracker(rate)
    step = 0.9 / rate
    frames = int(0.8 * rate)
    for frame in range(frames):
        track_boards(Board(-0.5 + step * frame, 2.0), Board(-1.4, 3.0, label=CHAIR))
    for gap in range(1, 2 * frames):
        hidden = Board(-0.5 + step * (frames + gap - 1), 2.0, detected=False)
        tracks = track_boards(hidden, Board(-1.4, 3.0, label=CHAIR))
        missed = [track for track in tracks if track.missed]
        if not missed:
            break
        assert [track.id for track in missed] == [1]
        truth = render([Board(hidden.x, 2.0)])[1].masks[0]
        predicted = missed[0].mask
        assert float((predicted & truth).sum()) / float(truth.sum()) > 0.9
        assert float((predicted & ~truth).sum()) / float(truth.sum()) < 0.3
        assert float((mask_centre(predicted) - mask_centre(truth)).abs().max()) < 2.0
    else:
        pytest.fail("the object was not removed")
    # Predicted for half a second, with one frame of rounding, then removed.
    assert gap - 1 in (int(0.5 * rate), int(0.5 * rate - 1e-9))
    assert [track.id for track in tracks] == [2]


def test_missed_object_is_kept_for_max_missed_time() -> None:
    track_boards = BoardTracker(10.0, max_missed_time=0.25)
    track_boards(Board(0.0))
    present = [len(track_boards()) for _ in range(4)]
    assert present == [1, 1, 0, 0]


def test_walker_detected_again_in_time_keeps_its_id() -> None:
    track_boards = BoardTracker()
    for frame in range(40):
        missed = 20 <= frame < 32
        tracks = track_boards(Board(-0.6 + 0.03 * frame, detected=not missed))
        assert [(track.id, track.missed) for track in tracks] == [(1, missed)]


def test_object_detected_again_too_late_gets_a_new_id() -> None:
    track_boards = BoardTracker(10.0, max_lost_time=0.0)
    previous_ids = set()
    for life in range(1, 5):
        for _ in range(2):
            (track,) = track_boards(Board(0.0))
            assert track.id == life
        assert track.id not in previous_ids
        previous_ids.add(track.id)
        for _ in range(6):
            tracks = track_boards()
        assert tracks == []


def test_missed_furniture_rests_without_a_mask_and_keeps_its_history() -> None:
    track_boards = BoardTracker()
    track_thrice(track_boards, Board(0.0, label=CHAIR))
    for _ in range(3):
        assert track_boards(Board(0.0, label=CHAIR, detected=False)) == []
    (resting,) = track_boards.tracker.resting
    assert resting.missed and not resting.is_shown and resting.mask.numel() == 0
    (track,) = track_boards(Board(0.0, label=CHAIR))
    assert track is resting and len(track.detections) == 4 and track_boards.tracker.resting == []


def test_missed_furniture_that_has_moved_is_predicted() -> None:
    track_boards = BoardTracker()
    track_thrice(track_boards, Board(0.0, label=CHAIR))
    (track,) = track_boards.tracker.tracks
    track.motion.mark_dynamic(0.1)
    (predicted,) = track_boards(Board(0.0, label=CHAIR, detected=False))
    assert predicted is track and track.missed and bool(track.mask.any())


def test_missed_furniture_that_was_once_detected_as_a_person_is_predicted() -> None:
    track_boards = BoardTracker()
    track_boards(Board(0.0, label=PERSON))
    track_thrice(track_boards, Board(0.0, label=CHAIR))
    (track,) = track_boards.tracker.tracks
    assert track.label == CHAIR
    (predicted,) = track_boards(Board(0.0, label=CHAIR, detected=False))
    assert predicted is track and track.missed and bool(track.mask.any())


def test_resting_furniture_is_lost_after_the_maximum_time_and_keeps_its_id() -> None:
    track_boards = BoardTracker()
    for _ in range(30):
        track_boards(Board(0.0, label=CHAIR))
    for _ in range(16):
        track_boards(Board(0.0, label=CHAIR, detected=False))
    assert track_boards.tracker.resting == []
    (lost,) = track_boards.tracker.lost
    assert len(lost.detections) == 1
    (track,) = track_boards(Board(0.0, label=CHAIR))
    assert track is lost and track.first_stamp == track.newest.stamp


def test_walker_without_centroids_is_expected_to_stop() -> None:
    track_boards = BoardTracker()
    for k in range(30):
        (track,) = track_boards(Board(-0.6 + k / 30))
    last, stamp = track.newest.centroid, track.newest.stamp
    assert float((track.predict_state(stamp + 0.4).position - last).norm()) == pytest.approx(0.4, abs=0.1)
    # Half a second at 1 m/s, and then 0.7 s, the time constant of the velocity.
    assert float((track.predict_state(stamp + 20).position - last).norm()) == pytest.approx(1.2, abs=0.1)


def test_tracker_restores_resting_and_lost_tracks() -> None:
    track_boards = BoardTracker(10.0)
    track_thrice(track_boards, Board(-0.8, label=DOG))
    for _ in range(6):  # hidden by a cupboard
        track_boards(Board(-0.8, 1.5, width=0.8, height=2.0, detected=False))
    track_thrice(track_boards, Board(0.8, label=CHAIR))
    track_boards()
    restored = BoardTracker(10.0)
    restored.tracker.load_state_dict(track_boards.tracker.state_dict())
    assert [track.id for track in restored.tracker.lost] == [1]
    assert [track.id for track in restored.tracker.resting] == [2]


def test_object_hidden_for_longer_than_the_maximum_lost_time_gets_a_new_id() -> None:
    """A cupboard hides the board."""
    track_boards = BoardTracker(10.0)
    track_thrice(track_boards, Board(0.0, 3.0))
    cupboard = Board(0.0, 1.5, width=1.0, height=2.0, detected=False)
    for _ in range(70):
        assert not any(track.is_shown for track in track_boards(Board(0.0, 3.0), cupboard))
    assert track_boards.tracker.lost == []
    assert [track.id for track in track_boards(Board(0.0, 3.0))] == [2]


def test_part_of_a_tracked_object_is_not_a_second_object() -> None:
    """The network finds a person, and the upper half of the same person again."""
    depth, instances = render([Board(0.0)])
    upper = instances.masks.clone()
    upper[:, CAMERA.height // 2 :] = False
    twice = instances.concatenate(replace(instances, masks=upper))
    tracker, back_project = BoardTracker().tracker, InstanceBackProjector(CLOUDS, CAMERA)
    tracker(0.0, instances, back_project(depth, instances), depth, HERE)
    tracks = tracker(1 / 30, twice, back_project(depth, twice), depth, HERE)
    assert [track.id for track in tracks] == [1]


def test_one_mask_over_two_people_does_not_hide_the_second_one() -> None:
    """The cloud of the mask is that of the larger person, who is nearer; the other one is missed, not lost."""
    track_boards, boards = BoardTracker(), [Board(-0.3, 2.0), Board(0.4, 3.0, height=1.0)]
    track_thrice(track_boards, *boards)
    depth, instances = render(boards)
    both = Instances.from_masks(instances.masks.any(dim=0, keepdim=True), instances.labels[:1])
    tracks = track_boards.track(depth, both, 0.1)
    assert [(track.id, track.missed) for track in tracks] == [(1, False), (2, True)]
    assert torch.equal(tracks[1].mask, instances.masks[1])
    assert [track.id for track in track_boards.track(depth, instances, 0.2)] == [1, 2]


def test_predicted_mask_follows_the_camera() -> None:
    track_boards = BoardTracker()
    track_thrice(track_boards, Board(0.0))
    T_wc = HERE.clone()
    T_wc[0, 3] = 0.4
    (track,) = track_boards(Board(0.0, detected=False), T_wc=T_wc)
    truth = render([Board(0.0)], T_wc)[1].masks[0]
    assert track.missed
    assert float((mask_centre(track.mask) - mask_centre(truth)).abs().max()) < 1.5


def test_predicted_mask_excludes_occluders_and_background() -> None:
    track_boards = BoardTracker()
    track_thrice(track_boards, Board(0.0, 3.0))
    post = Board(0.0, 1.5, width=0.05, height=2.0, detected=False)
    (track,) = track_boards(Board(0.0, 3.0, detected=False), post)
    depth, _ = render([Board(0.0, 3.0), post])
    assert int(track.mask.sum()) > 200
    assert float(depth[0][track.mask].min()) == 3.0
    assert float(depth[0][track.mask].max()) == 3.0


def test_predicted_mask_includes_pixels_without_depth() -> None:
    """Holes in the depth of the object belong to the object."""
    track_boards = BoardTracker()
    track_thrice(track_boards, Board(0.0))
    depth, _ = render([Board(0.0)])
    mask = render([Board(0.0)])[1].masks[0]
    depth[0, :, 75:85] = 0.0
    no_instances = Instances.empty(CAMERA.height, CAMERA.width)
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, no_instances)
    (track,) = track_boards.tracker(3 / 30, no_instances, clouds, depth, HERE)
    assert bool(track.mask[mask].all())


def test_predicted_mask_is_empty_outside_of_the_image() -> None:
    for xi in ([0.0, 0.0, 3.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.5, 0.0]):
        track_boards = BoardTracker()
        track_thrice(track_boards, Board(0.0))
        depth = torch.full((1, CAMERA.height, CAMERA.width), 2.0)
        no_instances = Instances.empty(CAMERA.height, CAMERA.width)
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, no_instances)
        (track,) = track_boards.tracker(
            3 / 30, no_instances, clouds, depth, se3_exp(torch.tensor(xi, dtype=torch.float64))
        )
        assert track.missed
        assert int(track.mask.sum()) == 0


def test_objects_without_centroid_are_matched_by_masks() -> None:
    """Two boards beyond the maximum depth have no clouds, but keep their ids."""
    track_boards = BoardTracker()
    for frame in range(5):
        shift = 0.02 * frame
        far = [Board(-1.5 + shift, 7.0, width=1.2, height=2.0), Board(1.5 - shift, 7.0, width=1.2, height=2.0)]
        depth, _ = render([])
        masks = []
        for board in far:
            point = CAMERA.rays * 7.0
            masks.append(((point[..., 0] - board.x).abs() < 0.6) & (point[..., 1].abs() < 1.0))
            depth[0, masks[-1]] = 7.0
        instances = Instances(torch.stack(masks), torch.zeros(2, dtype=torch.int64), torch.ones(2), torch.zeros(2, 4))
        tracks = track_boards.tracker(
            frame / 30, instances, InstanceBackProjector(CLOUDS, CAMERA)(depth, instances), depth, HERE
        )
        assert [track.id for track in tracks] == [1, 2]
        assert not any(track.newest.has_centroid for track in tracks)
    assert not tracks[0].velocity.any()


def test_missed_object_without_centroid_keeps_id_and_mask() -> None:
    track_boards = BoardTracker()
    depth, instances = render([Board(0.0)])
    depth[:, instances.masks[0]] = 7.0  # beyond the maximum depth of clouds
    for frame in range(4):
        found = Instances.empty(CAMERA.height, CAMERA.width) if frame in (1, 2) else instances
        (track,) = track_boards.track(depth, found, frame / 30)
        assert (track.id, track.missed) == (1, frame in (1, 2))
        assert torch.equal(track.mask, instances.masks[0])


def test_missed_object_without_centroid_has_no_pixels_where_something_else_is_measured() -> None:
    """A curtain at 1.5 m then hides half of the object."""
    track_boards, nothing = BoardTracker(), Instances.empty(CAMERA.height, CAMERA.width)
    depth, instances = render([Board(0.0)])
    depth[:, instances.masks[0]] = 7.0
    track_boards.track(depth, instances, 0.0)
    depth[:, :, 80:] = 1.5
    (track,) = track_boards.track(depth, nothing, 1 / 30)
    assert bool(track.mask[:, :80].any()) and not track.mask[:, 80:].any()


def test_missing_centroid_in_one_frame_keeps_id_and_velocity() -> None:
    track_boards = BoardTracker()
    for frame in range(12):
        depth, instances = render([Board(-0.3 + 0.03 * frame)])
        if frame == 8:
            depth = torch.zeros_like(depth)
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
        (track,) = track_boards.tracker(frame / 30, instances, clouds, depth, HERE)
        assert track.id == 1
        assert torch.isfinite(track.velocity).all()
    assert float(track.velocity[0]) == pytest.approx(0.9, abs=0.3)


def test_detections_of_a_pair_are_at_least_the_time_span_apart() -> None:
    track_boards = BoardTracker()
    for frame in range(20):
        (track,) = track_boards(Board(-0.3 + 0.01 * frame))
        pairs = {time_span: track.detection_pair(time_span) for time_span in (0.0, 0.3)}
        assert (pairs[0.0] is None) is (frame < 1)
        assert (pairs[0.3] is None) is (frame < 9)
    for time_span, expected in ((0.0, 1 / 30), (0.3, 0.3)):
        previous, current = pairs[time_span] or (None, None)
        assert current is track.newest
        assert previous is not None
        assert current.stamp - previous.stamp == pytest.approx(expected)


@pytest.mark.parametrize(("rate", "jitter"), [(30.0, 0.003), (5.0, 0.003), (3.5, 0.0), (2.3, 0.0)])
@pytest.mark.parametrize("time_span", [0.9, 1.0])
def test_detections_over_the_longest_time_spans_are_compared_at_any_rate(
    rate: float, jitter: float, time_span: float
) -> None:
    """A detection that is older than a second is kept while no other is old enough."""
    jitters = jitter * torch.randn(60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mask, centroid = torch.zeros(1, 1, dtype=torch.bool), torch.zeros(3, dtype=torch.float64)
    track = Track(1, 0.0, TrackerConfig(), mask, mask, *(torch.zeros(8, dtype=torch.uint8),) * 2)
    for number, noise in enumerate(jitters.tolist()):
        stamp = number / rate + noise
        track.add_detection(Detection3D(stamp, centroid, torch.zeros(5, 3)))
        if stamp > 1.0 + 1 / rate:
            pair = track.detection_pair(time_span)
            assert pair is not None and pair[1].stamp - pair[0].stamp < time_span + 1.2 / rate + 4 * jitter
    assert len(track.detections) <= rate * (1 + 4 * jitter) + 2


def test_detection_pair_needs_both_centroids() -> None:
    track_boards = BoardTracker()
    for no_depth in (False, True, False, False):
        track_boards.frame += 1
        depth, instances = render([Board(0.0)])
        depth = torch.zeros_like(depth) if no_depth else depth
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
        (track,) = track_boards.tracker(track_boards.frame / 30, instances, clouds, depth, HERE)
        assert (track.detection_pair(0.0) is not None) is (track_boards.frame == 3)


def test_detections_are_bounded_by_the_history() -> None:
    track_boards = BoardTracker()
    for _ in range(60):
        (track,) = track_boards(Board(0.0))
    assert len(track.detections) == 31
    assert track.newest.stamp - track.detections[0].stamp == pytest.approx(1.0)
    assert track.first_stamp == 0.0


@pytest.mark.parametrize("all_tracks", [False, True])
@pytest.mark.parametrize("guesses", [(5,), (5, 6, 7)], ids=["one frame", "all frames"])
def test_end_of_a_guess_moves_what_was_seen_since_or_all(guesses: tuple[int, ...], all_tracks: bool) -> None:
    """The motion of the camera was not measured before one frame, or before several in a row."""
    track_boards, offset = BoardTracker(), HERE.clone()
    offset[0, 3] = 0.3
    for frame in range(8):
        if frame in guesses:
            track_boards.tracker.start_guessed_world(frame / 30)
        depth, instances = render([Board(0.0)], HERE)
        (track,) = track_boards.track(depth, instances, frame / 30, T_wc=offset if frame >= 5 else HERE)
    assert track_boards.tracker.comparable_since == guesses[-1] / 30
    track_boards.tracker.move_to_map(invert(offset), all_tracks=all_tracks)
    places = [round(float(detection.centroid[0]), 2) for detection in track.detections]
    assert places == (5 * [-0.3] + 3 * [0.0] if all_tracks else 8 * [0.0])
    track_boards.tracker.move_to_map(offset)  # no guess any more
    assert [round(float(detection.centroid[0]), 2) for detection in track.detections] == places
    assert all_tracks or float(track.velocity.norm()) < 0.05


@settings(max_examples=10)
@given(st.tuples(*[st.floats(-2.0, 2.0)] * 3, *[st.floats(-1.0, 1.0)] * 3))
def test_world_correction_moves_the_whole_track(xi: tuple[float, ...]) -> None:
    """After a correction, everything is as if the world had been the corrected one from the start."""
    T_new_old = se3_exp(torch.tensor(xi, dtype=torch.float64))
    corrected, always = BoardTracker(), BoardTracker()
    for frame in range(6):
        boards = [Board(-0.5 + 0.03 * frame), Board(0.8, 3.0)]
        T_wc = HERE.clone()
        T_wc[2, 3] = -0.02 * frame
        if frame == 4:
            corrected.tracker.apply_world_correction(T_new_old)
        depth, instances = render(boards, T_wc)
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
        arguments = (frame / 30, instances, clouds, depth)
        old = corrected.tracker(*arguments, T_new_old @ T_wc if frame >= 4 else T_wc)
        new = always.tracker(*arguments, T_new_old @ T_wc)
    assert [track.id for track in old] == [track.id for track in new] == [1, 2]
    for a, b in zip(old, new, strict=True):
        torch.testing.assert_close(a.velocity, b.velocity, rtol=0.0, atol=1e-6)
        torch.testing.assert_close(a.predict_state(0.5).position, b.predict_state(0.5).position, rtol=0.0, atol=1e-6)
        for s, r in zip(a.detections, b.detections, strict=True):
            torch.testing.assert_close(s.centroid, r.centroid, rtol=0.0, atol=1e-6)
            torch.testing.assert_close(s.cloud, r.cloud, rtol=0.0, atol=1e-5)


def test_convention_detections_are_in_the_world_frame() -> None:
    """The camera is at (0.5, 0, -1) turned by 90 degrees around the vertical axis: its z is the world x."""
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
    T_wc = HERE.clone()
    T_wc[:3, :3], T_wc[:3, 3] = turn, torch.tensor([0.5, 0.0, -1.0])
    depth, instances = render([Board(0.3, 2.0)])
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
    (track,) = BoardTracker().tracker(0.0, instances, clouds, depth, T_wc)
    expected = torch.tensor([2.5, 0.0, -1.3], dtype=torch.float64)
    assert float((track.newest.centroid - expected).abs().max()) < 0.02
    torch.testing.assert_close(track.newest.cloud.double().mean(dim=0), track.newest.centroid, rtol=0.0, atol=1e-5)


def test_no_instances_give_no_tracks() -> None:
    track_boards = BoardTracker()
    assert [track_boards(), track_boards()] == [[], []]


def test_hundred_objects_in_random_order_keep_their_ids() -> None:
    """A grid of small boards that all move by 3 cm between the frames."""
    generator = torch.Generator().manual_seed(0)
    track_boards = BoardTracker()
    positions = [(0.22 * c - 1.0, 0.15 * r - 0.7) for r in range(10) for c in range(10)]
    for frame in range(3):
        boards = [Board(x + 0.03 * frame, 2.0, y, width=0.17, height=0.12) for x, y in positions]
        order = torch.arange(100) if frame == 0 else torch.randperm(100, generator=generator)
        tracks = track_boards(*(boards[i] for i in order))
        assert [track.id for track in tracks] == list(range(1, 101))
        for i in (0, 37, 62, 99):
            assert at(tracks, boards[i]).id == i + 1


def test_equal_stamps_keep_id_and_velocity() -> None:
    track_boards = BoardTracker()
    for frame in range(10):
        track_boards(Board(0.03 * frame), stamp=0.03 * frame)
        (track,) = track_boards(Board(0.03 * frame), stamp=0.03 * frame)
    assert track.id == 1
    assert float((track.velocity - torch.tensor([1.0, 0.0, 0.0])).norm()) < 0.2
    assert float(track.predict_state(0.27).position[0]) == pytest.approx(0.27, abs=0.03)


def test_result_of_a_frame_is_not_changed_by_the_next_frame() -> None:
    track_boards = BoardTracker()
    first = track_boards(Board(0.0))
    track_boards(Board(0.0), Board(0.8))
    assert [track.id for track in first] == [1]


def test_state_dict_continues_with_identical_results() -> None:
    """One object is missed when the state is copied, and a new one gets the next id afterwards."""
    original, continued = BoardTracker(), BoardTracker()
    for frame in range(24):
        boards = [Board(-0.5 + 0.03 * frame), Board(0.9, 3.0, detected=frame not in (9, 10, 11))]
        boards += [Board(-1.2, 3.0, label=CHAIR)] * (frame >= 15)
        tracks = original(*boards)
        if frame == 10:
            continued.tracker.load_state_dict(copy.deepcopy(original.tracker.state_dict()))
            continued.frame = original.frame
        if frame > 10:
            others = continued(*boards)
            assert [(t.id, t.missed, t.label) for t in tracks] == [(t.id, t.missed, t.label) for t in others]
            for track, other in zip(tracks, others, strict=True):
                assert torch.equal(track.mask, other.mask) and torch.equal(track.velocity, other.velocity)
                assert torch.equal(track.predict_state(1.0).position, other.predict_state(1.0).position)
                assert len(track.detections) == len(other.detections)
    assert [track.id for track in tracks] == [1, 2, 3]


def test_end_of_a_guess_keeps_the_position_that_the_refined_mask_shows() -> None:
    track_boards, offset = BoardTracker(), HERE.clone()
    offset[0, 3] = 0.3
    track_boards(Board(0.0))
    track_boards.tracker.start_guessed_world(1 / 30)
    (track,) = track_boards.track(*render([Board(0.0)], HERE), 1 / 30, T_wc=offset)
    surface = torch.tensor([0.4, 0.1, 2.0], dtype=torch.float64)
    track.record_visible_state(surface)
    track_boards.tracker.move_to_map(invert(offset))
    expected = surface - offset[:3, 3]
    torch.testing.assert_close(track.predict_visible_state(1 / 30).position, expected)
    torch.testing.assert_close(track.history[-1].position, expected)


def test_object_detected_again_is_shown() -> None:
    track_boards = BoardTracker()
    for frame in range(40):
        (track,) = track_boards(Board(-0.6 + 0.03 * frame, detected=not 20 <= frame < 32))
        assert track.is_shown is (frame < 23 or frame >= 32)


def test_what_the_first_frame_shows_moves_to_the_map_in_which_the_camera_is_found() -> None:
    track_boards, offset = BoardTracker(), HERE.clone()
    offset[0, 3] = 3.0
    track_boards.tracker.start_guessed_world(0.0)
    depth, instances = render([Board(0.0)], HERE)
    (track,) = track_boards.track(depth, instances, 0.0, T_wc=HERE)
    track_boards.tracker.move_to_map(offset)
    (moved,) = track_boards.track(depth, instances, 1 / 30, T_wc=offset)
    assert moved is track and float(track.detections[0].centroid[0]) == pytest.approx(3.0, abs=0.01)
    assert float(track.velocity.norm()) < 0.05


@pytest.mark.parametrize("stamp", [-1e6, -10.0, 0.0, 1.7e9])
def test_object_without_a_centroid_has_no_state_at_any_time(stamp: float) -> None:
    mask = torch.zeros(4, 4, dtype=torch.bool)
    track = Track(1, stamp, TrackerConfig(), mask, mask, *(torch.zeros(2, dtype=torch.uint8),) * 2)
    unknown = torch.full((3,), torch.nan, dtype=torch.float64)
    track.update_label(PERSON, 1.0)
    track.add_detection(Detection3D(stamp, unknown, torch.zeros(0, 3)))
    for state in (track.predict_state(stamp + 2), track.predict_unobserved_state(stamp + 2)):
        assert state.stamp == stamp + 2 and not state.is_known and state.variances == (1.0, 0.0, 1.0)
