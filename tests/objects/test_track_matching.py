"""Evidence for pairs of tracks and instances, on boards in front of a wall."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.boards import CAMERA, CHAIR, CLOUDS, HERE, Board, BoardTracker, render

from v3d_torch.config import TrackerConfig
from v3d_torch.objects.appearance import HISTOGRAM_SIZE
from v3d_torch.objects.instance_clouds import InstanceBackProjector
from v3d_torch.objects.track import Track
from v3d_torch.objects.track_matching import DetectedInstances, compare_tracks, predict_tracks, to_detections


def log_ratio_of(before: list[Board], after: list[Board], appearance: torch.Tensor | None = None) -> torch.Tensor:
    """Return the log-likelihood ratio of each pair of a board before (three frames) and a detected board after."""
    track_boards = BoardTracker()
    for _ in range(3):
        tracks = track_boards(*before)
    if appearance is not None:
        for track in tracks:
            track.appearance = torch.eye(HISTOGRAM_SIZE)[0]
    depth, instances = render(after)
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
    detected = to_detections(0.1, instances, clouds, appearance, HERE, 1)
    predicted = predict_tracks(tracks, 0.1, depth, HERE, CAMERA, CLOUDS, 1)
    return compare_tracks(predicted, [], detected, TrackerConfig())


def log_ratio_of_lost(track: Track, detected: DetectedInstances) -> torch.Tensor:
    """Return the log-likelihood ratio of each detected board with a track without a predicted mask, (N,)."""
    nothing = predict_tracks([], detected.stamp, torch.zeros(1, CAMERA.height, CAMERA.width), HERE, CAMERA, CLOUDS, 1)
    return compare_tracks(nothing, [track], detected, TrackerConfig())[0]


def test_board_continues_itself_rather_than_its_neighbour() -> None:
    boards = [Board(-0.3), Board(0.3)]
    ratio = log_ratio_of(boards, boards)
    assert bool((ratio.diag() > 5).all())
    assert ratio[0, 1] == ratio[1, 0] == -torch.inf  # both are visible where they were predicted


def test_other_appearance_is_evidence_against_a_pair() -> None:
    same, other = (torch.eye(HISTOGRAM_SIZE)[i : i + 1] for i in (0, 1))
    boards = [Board(0.0)]
    assert float(log_ratio_of(boards, boards, same) - log_ratio_of(boards, boards, other)) > 5


def test_lost_track_beyond_the_gate_is_impossible() -> None:
    (track,) = BoardTracker()(Board(-0.5))
    depth, instances = render([Board(-0.4), Board(0.9)])
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
    detected = to_detections(0.1, instances, clouds, None, HERE, 1)
    near, far = log_ratio_of_lost(track, detected).tolist()
    assert near > 0
    assert far == -torch.inf


@pytest.mark.parametrize(("colour", "likely"), [(0, True), (1, False)])
def test_track_lost_for_seconds_is_found_again_by_its_colours(colour: int, likely: bool) -> None:
    (track,) = BoardTracker()(Board(0.0))
    track.update_appearance(torch.eye(HISTOGRAM_SIZE)[0])
    depth, instances = render([Board(0.1)])
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
    detected = to_detections(4.0, instances, clouds, torch.eye(HISTOGRAM_SIZE)[colour][None], HERE, 1)
    assert bool(log_ratio_of_lost(track, detected) > 0) is likely


def test_colours_of_a_lost_track_are_those_of_all_its_views_not_of_the_last_small_one() -> None:
    """The board leaves the image, so that its last view is narrow."""
    ratios, colours = [], torch.eye(HISTOGRAM_SIZE)[:1]
    for last in (Board(0.0), Board(0.0, width=0.05)):
        track_boards = BoardTracker()
        for frame, board in enumerate([*[Board(0.0)] * 9, last]):
            (track,) = track_boards.track(*render([board]), frame / 30, appearance=colours)
        depth, instances = render([Board(0.1)])
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
        detected = to_detections(4.0, instances, clouds, colours, HERE, 1)
        ratios.append(float(log_ratio_of_lost(track, detected)))
    assert ratios[1] > ratios[0] - 0.5


def test_empty_place_is_no_evidence_against_the_return_of_a_lost_track() -> None:
    (track,) = BoardTracker()(Board(0.0))
    depth, instances = render([Board(0.1)])
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
    detected = to_detections(1.0, instances, clouds, None, HERE, 1)
    before = log_ratio_of_lost(track, detected)
    track.add_vacated_time(0.3, 0.3)
    assert track.vacated_log_ratio < 0
    assert torch.equal(log_ratio_of_lost(track, detected), before)


def test_evidence_of_an_empty_place_starts_anew_with_each_detection() -> None:
    found = []
    for was_vacated in (False, True):
        track_boards = BoardTracker()
        (track,) = track_boards(Board(0.0))
        if was_vacated:
            track.add_vacated_time(0.02, 0.02)
        track_boards(Board(0.0))
        track.add_vacated_time(0.04, 0.01)
        found.append((track.vacated_time, track.vacated_log_ratio))
    assert found[0] == found[1] and found[0][1] < 0


def test_lost_walker_is_expected_where_a_person_slows_down() -> None:
    """A board where the decaying velocity leads is more likely the walker than one where constant velocity leads."""
    track_boards = BoardTracker()
    for frame in range(20):
        (track,) = track_boards(Board(-1.0 + frame / 30))
    stamp = track.newest.stamp + 0.4
    expected, constant = (
        float(state.position[0]) for state in (track.predict_unobserved_state(stamp), track.predict_state(stamp))
    )
    assert constant - expected > 0.08
    ratios = []
    for x in (expected, constant):
        depth, instances = render([Board(x)])
        clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
        detected = to_detections(stamp, instances, clouds, None, HERE, 1)
        ratios.append(float(log_ratio_of_lost(track, detected)))
    assert ratios[0] > ratios[1]


def test_empty_predicted_mask_is_no_evidence_against_an_instance() -> None:
    """The points are visible, but none of them is at a pixel of the coarse mask."""
    track_boards = BoardTracker()
    for _ in range(3):
        tracks = track_boards(Board(0.0))
    depth, instances = render([Board(0.0)])
    clouds = InstanceBackProjector(CLOUDS, CAMERA)(depth, instances)
    detected = to_detections(0.1, instances, clouds, None, HERE, 1)
    predicted = predict_tracks(tracks, 0.1, depth, HERE, CAMERA, CLOUDS, 1)
    empty = replace(predicted, coarse_masks=torch.zeros_like(predicted.coarse_masks))
    hidden = replace(empty, visible_fractions=torch.zeros_like(predicted.visible_fractions))
    assert predicted.visible.all()
    ratios = [compare_tracks(each, [], detected, TrackerConfig()) for each in (empty, hidden)]
    assert torch.equal(*ratios) and ratios[0].isfinite().all()


def test_state_of_the_visible_part_follows_its_centroid() -> None:
    """A curtain hides the right half of a board: the centroid of the rest is 0.2 m to the left of the whole."""
    track_boards = BoardTracker()
    for boards in 10 * [(Board(0.0, width=0.8),)] + [(Board(0.0, width=0.8), Board(0.3, 1.5, 0.0, 0.6, 2.0, CHAIR))]:
        track = track_boards(*boards)[0]
    stamp = track.newest.stamp
    assert float(track.newest.centroid[0]) < -0.15
    visible, whole = (
        each(stamp).position - track.newest.centroid for each in (track.predict_visible_state, track.predict_state)
    )
    assert visible.norm() < 0.03 < 0.1 < whole.norm()
