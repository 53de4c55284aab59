"""Landmarks of a map and the images that observe them."""

from __future__ import annotations

import torch
from helpers.sparse_maps import EYE, features, make_map
from torch import Tensor

from v3d_torch.export.landmark_tracks import has_keyframes, landmark_tracks
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.types import Trajectory

COUNT = 20
T_CW = torch.stack([EYE, *(se3_exp(torch.full((6,), 0.01 * i, dtype=torch.float64)) for i in (1, 2))])


def make_tables() -> SparseMap:
    """Map of three keyframes at 0, 1 and 2 s; all of them observe the landmarks of the first."""
    tables, seen = make_map(), features(COUNT)
    first = tables.insert_keyframe(0, 0.0, T_CW[0], seen, torch.full((COUNT,), -1))
    for index in (1, 2):
        tables.insert_keyframe(10 * index, float(index), T_CW[index], seen, first.landmarks.clone())
    return tables


def images(*stamps: float, T_cw: Tensor = T_CW) -> Trajectory:
    return Trajectory(torch.tensor(stamps, dtype=torch.float64), invert(T_cw[[int(stamp) for stamp in stamps]]))


def test_landmarks_of_two_keyframes_have_their_pixels_and_positions() -> None:
    tables = make_tables()
    tracks = landmark_tracks(tables, images(0.0, 0.5, 2.0))  # no keyframe at 0.5 s
    assert len(tracks.points) == COUNT
    assert tracks.image.tolist() == [0] * COUNT + [2] * COUNT
    assert tracks.landmark.tolist() == 2 * list(range(COUNT))
    torch.testing.assert_close(tracks.points, tables.landmarks["point"])
    torch.testing.assert_close(tracks.uv, features(COUNT).uv.repeat(2, 1))


def test_landmarks_of_one_image_and_inactive_landmarks_are_left_out() -> None:
    tables = make_tables()
    assert len(landmark_tracks(tables, images(1.0)).points) == 0
    tables.landmarks["active"][3] = False
    tracks = landmark_tracks(tables, images(0.0, 1.0))
    kept = [index for index in range(COUNT) if index != 3]
    torch.testing.assert_close(tracks.points, tables.landmarks["point"][kept])
    assert tracks.landmark.max() == COUNT - 2


def test_removed_observations_are_left_out() -> None:
    tables = make_tables()
    tables.remove_observations(torch.tensor([0, COUNT]))  # of the first landmark by keyframes 0 and 1
    tracks = landmark_tracks(tables, images(0.0, 1.0, 2.0))
    assert len(tracks.points) == COUNT - 1


def test_keyframe_of_the_same_time_with_another_pose_is_ignored() -> None:
    moved = T_CW.clone()
    moved[2, 0, 3] += 0.001
    assert len(landmark_tracks(make_tables(), images(0.0, 2.0, T_cw=moved)).points) == 0


def test_empty_map_or_no_images_have_no_landmarks() -> None:
    assert len(landmark_tracks(make_map(), images(0.0, 1.0)).points) == 0
    empty = Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
    tracks = landmark_tracks(make_tables(), empty)
    assert (len(tracks.points), len(tracks.image), tracks.uv.shape) == (0, 0, (0, 2))


def test_map_of_another_run_has_not_all_keyframes() -> None:
    tables = make_tables()
    assert has_keyframes(tables, images(0.0, 1.0, 2.0))
    assert has_keyframes(tables, images(0.0, 2.0))  # the map of a run with --load-map has more
    moved = T_CW.clone()
    moved[1:, 0, 3] += 0.001
    assert not has_keyframes(tables, images(0.0, 1.0, 2.0, T_cw=moved))
    assert not has_keyframes(make_map(), images(0.0))
