"""Calibration of a camera from views and measured poses: delay and depth scale; `test_selection` has the intrinsics."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers.board_room import CAMERA, make_views

from v3d_torch.calibration import camera_calibration
from v3d_torch.calibration.camera_calibration import Calibration, calibrate_camera
from v3d_torch.calibration.selection import AGREES, NOT_DETERMINED, Estimate
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.types import Trajectory

COUNT = 12


@pytest.fixture(autouse=True)
def no_intrinsics(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the calibration by the map."""
    monkeypatch.setattr(camera_calibration, "SelfCalibration", lambda *_, **__: None)
    monkeypatch.setattr(camera_calibration, "ParameterSelection", lambda _: SimpleNamespace(estimates=()))
    monkeypatch.setattr(camera_calibration, "better_focal_lengths", lambda _, camera, __: (camera.fx, camera.fy))


def calibrate(
    scale: float | None = None, delay: float = 0.0, given: PinholeCamera = CAMERA, shift: int = 0
) -> Calibration:
    """Calibrate from views with a delay of depth.

    Args:
        scale: Size of the measured trajectory relative to the estimated one; None without measured poses.
        delay: Time of the depth image minus time of the colour image, seconds.
        given: Given camera.
        shift: Shift of the depth images to the right, pixels.
    """
    views, _ = make_views(COUNT, delay=delay, shift=(shift, 0))
    _, trajectory = make_views(COUNT)
    groundtruth = None
    if scale is not None:
        T_wc, estimated = trajectory.T_wc.clone(), trajectory.T_wc.clone()
        noise = torch.randn(len(T_wc), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        T_wc[:, :3, 3] *= scale
        estimated[:, :3, 3] += 0.0001 * noise
        groundtruth, trajectory = Trajectory(trajectory.stamps, T_wc), Trajectory(trajectory.stamps, estimated)
    return calibrate_camera(MapTables(), views, trajectory, groundtruth, given, given, Config())


def estimate_of(calibration: Calibration, name: str) -> Estimate:
    return next(each for each in calibration.estimates if each.name == name)


def test_delay_of_depth_is_accepted() -> None:
    calibration = calibrate(delay=0.04)
    estimate = estimate_of(calibration, "depth_delay")
    assert estimate.accepted and estimate.value == pytest.approx(0.04, abs=4 * estimate.sigma)
    assert calibration.camera.depth_delay == estimate.value


@pytest.mark.parametrize(("delay", "accepted"), [(0.05, True), (0.02, False)])
def test_delay_of_depth_includes_that_of_the_given_camera(delay: float, accepted: bool) -> None:
    calibration = calibrate(delay=delay, given=replace(CAMERA, depth_delay=0.02))
    estimate = estimate_of(calibration, "depth_delay")
    assert estimate.value == pytest.approx(delay, abs=3e-3) and estimate.accepted is accepted
    assert calibration.camera.depth_delay == (estimate.value if accepted else 0.02)


@pytest.mark.parametrize("shift", [3, 6])
def test_delay_is_estimated_only_if_the_depth_is_registered(shift: int) -> None:
    """Registered means a shift below a hundredth of the width, 3.2 pixels."""
    estimate = estimate_of(calibrate(delay=0.04, shift=shift), "depth_delay")
    assert (estimate.accepted, estimate.reason) == ((True, "") if shift == 3 else (False, NOT_DETERMINED))


def test_depth_scale_is_determined_by_measured_poses_only() -> None:
    """A room of twice the size in metres means half the units per metre."""
    calibration = calibrate(scale=2.0)
    estimate = estimate_of(calibration, "depth_scale")
    assert estimate.accepted and estimate.value == pytest.approx(2500.0, rel=1e-3)
    assert calibration.camera.depth_scale == estimate.value
    untold = calibrate()
    estimate = estimate_of(untold, "depth_scale")
    assert not estimate.accepted and estimate.reason == NOT_DETERMINED and untold.camera.depth_scale == 5000.0


def test_right_delay_and_scale_are_left() -> None:
    calibration = calibrate(scale=1.0)
    for name in ("depth_delay", "depth_scale"):
        estimate = estimate_of(calibration, name)
        assert not estimate.accepted and estimate.reason == AGREES


def test_depth_in_floating_point_has_no_scale() -> None:
    calibration = calibrate(scale=2.0, given=replace(CAMERA, depth_scale=None))
    assert all(each.name != "depth_scale" for each in calibration.estimates)
    assert calibration.camera.depth_scale is None


def test_camera_at_rest_determines_no_delay() -> None:
    views, trajectory = make_views(COUNT, moving=False)
    calibration = calibrate_camera(MapTables(), views, trajectory, None, CAMERA, CAMERA, Config())
    assert estimate_of(calibration, "depth_delay").reason == NOT_DETERMINED


@pytest.mark.parametrize(("fx", "next_fx"), [(270.0, 260.0), (320.0, 320.0)])
def test_next_run_has_focal_lengths_that_differ_significantly(
    fx: float, next_fx: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are not accurate enough to be accepted, so that the calibrated camera keeps the given ones."""
    estimates = tuple(Estimate(name, 260.0, fx, 15.0, accepted=False, reason="") for name in ("fx", "fy"))
    monkeypatch.setattr(camera_calibration, "ParameterSelection", lambda _: SimpleNamespace(estimates=estimates))
    monkeypatch.setattr(camera_calibration, "better_focal_lengths", lambda *_: None)
    calibration = calibrate()
    assert (calibration.camera.fx, calibration.camera.fy) == (260.0, 260.0)
    assert (calibration.next_camera.fx, calibration.next_camera.fy) == (next_fx, next_fx)


def test_next_run_has_the_focal_lengths_of_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_calibration, "better_focal_lengths", lambda *_: (500.0, 510.0))
    calibration = calibrate()
    assert (calibration.next_camera.fx, calibration.next_camera.fy) == (500.0, 510.0)
    assert calibration.camera.fx == CAMERA.fx
