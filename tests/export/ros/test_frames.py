"""Coordinate frames of the messages: axes of REP 103, and an odometry frame without jumps."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.export.ros.frames import T_LINK_OPTICAL, OdometryFrame, camera_in_map, map_frame, points_in_map
from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.geometry.se3 import se3_exp

EYE = torch.eye(4, dtype=torch.float64)
AS_SEEN = map_frame(None)

poses = st.lists(st.floats(-2, 2), min_size=6, max_size=6).map(lambda v: se3_exp(torch.tensor(v, dtype=torch.float64)))


def move(x: float, y: float, z: float) -> Tensor:
    T = EYE.clone()
    T[:3, 3] = torch.tensor([x, y, z])
    return T


def test_convention_map_has_x_forward_y_left_z_up() -> None:
    right, down, forward = torch.eye(3, dtype=torch.float64)
    assert points_in_map(forward, AS_SEEN).tolist() == [1, 0, 0]
    assert points_in_map(-right, AS_SEEN).tolist() == [0, 1, 0]
    assert points_in_map(-down, AS_SEEN).tolist() == [0, 0, 1]


def test_convention_camera_that_moves_forward_moves_along_x_of_map() -> None:
    torch.testing.assert_close(camera_in_map(move(0, 0, 2), AS_SEEN), move(2, 0, 0))
    torch.testing.assert_close(camera_in_map(EYE, AS_SEEN), EYE)


@given(poses)
def test_point_is_the_same_by_camera_and_by_world(T_wc: Tensor) -> None:
    point = torch.tensor([0.3, -0.2, 1.5, 1.0], dtype=torch.float64)
    for T_mw in (AS_SEEN, level_frame(torch.tensor([0.4, -0.8, 0.3]))):
        by_camera = camera_in_map(T_wc, T_mw) @ T_LINK_OPTICAL @ point
        torch.testing.assert_close(by_camera[:3], points_in_map((T_wc @ point)[:3], T_mw))


@given(st.lists(poses, min_size=2, max_size=6))
def test_odometry_in_uncorrected_map_is_motion_since_the_first_frame(cameras: list[Tensor]) -> None:
    odometry = OdometryFrame()
    first = cameras[0]
    for before, previous, current in zip([first, first, *cameras], [first, *cameras], cameras, strict=False):
        odometry.update(before, previous, current)
        torch.testing.assert_close(odometry.T_mo @ odometry.T_ol, current)
        torch.testing.assert_close(odometry.T_mo[:3, 3], cameras[0][:3, 3])
        torch.testing.assert_close(odometry.T_mo[2, :3], EYE[2, :3])  # z up, as in map


def test_odometry_begins_with_the_yaw_of_the_first_camera() -> None:
    """The camera is pitched downwards in a level map."""
    odometry, T_ml = OdometryFrame(), se3_exp(torch.tensor([1.0, 2, 3, 0, 0, 0.5], dtype=torch.float64))
    pitch = se3_exp(torch.tensor([0, 0, 0, 0, 0.6, 0], dtype=torch.float64))
    odometry.update(*[T_ml @ pitch] * 3)
    torch.testing.assert_close(odometry.T_ol, pitch)
    torch.testing.assert_close(odometry.T_mo, T_ml)


def test_correction_of_the_map_moves_the_odometry_frame_and_not_the_camera_in_it() -> None:
    odometry = OdometryFrame()
    odometry.update(EYE, EYE, EYE)
    odometry.update(EYE, EYE, move(1, 0, 0))
    T_new_old = se3_exp(torch.tensor([0.1, 0.2, 0.0, 0.0, 0.0, 0.3], dtype=torch.float64))
    odometry.update(T_new_old, T_new_old @ move(1, 0, 0), T_new_old @ move(1.5, 0, 0))
    torch.testing.assert_close(odometry.T_ol, move(1.5, 0, 0))
    torch.testing.assert_close(odometry.T_mo @ odometry.T_ol, T_new_old @ move(1.5, 0, 0))
    torch.testing.assert_close(odometry.T_mo, T_new_old)


def test_convention_orientations_stay_orthonormal_over_many_frames() -> None:
    odometry, T_pl = OdometryFrame(), se3_exp(torch.tensor([0.1, 0, 0, 0.02, 0.01, 0.03], dtype=torch.float64))
    for _ in range(2000):
        odometry.update(EYE, T_pl, T_pl @ T_pl)
    R = odometry.T_ol[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)


def test_refinement_of_the_previous_frame_is_a_part_of_the_motion() -> None:
    """Each pose is 0.01 m too far when it is new, and right once the next frame is known."""
    odometry = OdometryFrame()
    odometry.update(EYE, EYE, EYE)
    for n in range(1, 11):
        odometry.update(move(0.1 * max(n - 2, 0), 0, 0), move(0.1 * (n - 1), 0, 0), move(0.1 * n + 0.01, 0, 0))
    torch.testing.assert_close(odometry.T_ol, move(1.01, 0, 0))
    odometry.turn_map(move(7, 0, 0))
    torch.testing.assert_close(odometry.T_ol, move(1.01, 0, 0))
    torch.testing.assert_close(odometry.T_mo, move(5.99, 0, 0))
