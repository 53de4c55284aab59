"""Plausibility checks: each warning for a map and views that contradict the camera, and none if they agree."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import torch
from helpers.board_room import CAMERA, make_views
from helpers.calibration_map import TRUE, make_map
from torch import Tensor

from v3d_torch.calibration.plausibility import _check_depth_scale, check_plausibility
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import STORED_UNIT
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.types import Trajectory

KINECT = CAMERA  # has its field of view


def check(
    views: StaticViews, trajectory: Trajectory, tables: MapTables | None = None, camera: PinholeCamera = CAMERA
) -> list[str]:
    return check_plausibility(tables or MapTables(), views, [], trajectory, camera, Config())


def no_views() -> tuple[StaticViews, Trajectory]:
    return StaticViews(CAMERA, 2), make_views(1, moving=False)[1]


def slanted_depth() -> Tensor:
    """Depth of slanted surfaces between 0.8 and 4 m, metres, (120, 160)."""
    rows, columns = torch.linspace(0, 1, 120)[:, None], torch.linspace(0, 1, 160)
    return torch.where(columns < 0.5, 0.8 + 1.5 * columns + rows, 2 + 1.5 * columns + 0.5 * rows)


def step_views(factor: float) -> tuple[StaticViews, Trajectory]:
    """Views of slanted surfaces by a Kinect whose depth is too large by a factor."""
    views, trajectory = make_views(6)
    stepped = StaticViews(CAMERA, 2)
    for view in views:
        inverse = 0.0029 * (1 / (0.0029 * slanted_depth())).round()
        units = (factor / inverse / STORED_UNIT).round().clamp(0, 65535).to(torch.uint16)
        stepped.append(replace(view, depth_units=units))
    return stepped, trajectory


def test_no_warning_if_camera_and_depth_agree() -> None:
    assert check(*make_views(6)) == []
    assert check(*step_views(1.0), camera=KINECT) == []
    assert check(*no_views(), make_map(TRUE), TRUE) == []
    assert check(*make_views(6, delay=0.03)) == []  # within half a frame period


def test_no_warning_without_data() -> None:
    assert check(*no_views()) == []


def test_warning_about_depth_that_is_not_registered() -> None:
    (warning,) = check(*make_views(6, shift=(20, -10)))
    found = re.fullmatch(
        r"the depth images seem to be shifted by \((\d+), -(\d+)\) pixels against the colour images;"
        " export depth that is registered to the colour image",
        warning,
    )
    assert found is not None and int(found[1]) == pytest.approx(20, abs=1) and int(found[2]) == pytest.approx(10, abs=1)


def test_warning_about_depth_that_is_not_registered_if_the_camera_stands_still() -> None:
    """Its views tell no delay, but a shift alone explains them."""
    warnings = check(*make_views(6, shift=(20, -10), moving=False))
    assert any(warning.startswith("the depth images seem to be shifted by ") for warning in warnings)


@pytest.mark.parametrize(("delay", "text"), [(0.1, "0.10 s after"), (-0.08, "0.08 s before")])
def test_warning_about_depth_of_another_time(delay: float, text: str) -> None:
    (warning,) = check(*make_views(6, delay=delay))
    assert warning.startswith(f"the depth images seem to be taken {text} the time of their timestamps")


@pytest.mark.parametrize("factors", [(2.0, 2.0), (0.5, 1.0), (0.5, 0.5)])
def test_warning_about_a_wrong_focal_length(factors: tuple[float, float]) -> None:
    wrong = replace(
        TRUE, fx=factors[0] * TRUE.fx, fy=factors[1] * TRUE.fy, cx=factors[0] * TRUE.cx, cy=factors[1] * TRUE.cy
    )
    (warning,) = check(*no_views(), make_map(wrong, noise=0.3), wrong)
    assert warning.startswith(f"the focal lengths {wrong.fx:g} and {wrong.fy:g} do not explain how the images move")


@pytest.mark.parametrize(
    ("factor", "text"), [(1.25, "1.25 times too small"), (0.8, "1.25 times too large"), (0.2, "5 times too large")]
)
def test_warning_about_a_depth_scale_that_contradicts_the_steps_of_a_kinect(factor: float, text: str) -> None:
    warnings = [each for each in check(*step_views(factor), camera=KINECT) if "depth_scale" in each]
    assert len(warnings) == 1 and "steps of the depth images" in warnings[0] and text in warnings[0]


def test_steps_of_other_cameras_are_not_compared_with_a_kinect() -> None:
    assert not any("steps" in warning for warning in check(*step_views(1.25), camera=replace(CAMERA, fx=192.0)))
    assert not any("steps" in warning for warning in check(*step_views(2.0), camera=KINECT))


@pytest.mark.parametrize(("scale", "text"), [(5.0, "too small"), (0.06, "too large")])
def test_warning_about_depth_outside_the_range_of_cameras(scale: float, text: str) -> None:
    warnings = [each for each in check(*make_views(6, scale=scale)) if "depth_scale" in each]
    assert len(warnings) == 1 and warnings[0].endswith(f"the depth_scale 5000 seems to be {text}")


def test_depth_of_large_images_is_checked() -> None:
    """Four views have more pixels than `torch.quantile` accepts."""
    camera = PinholeCamera(2100.0, 2100.0, 1055.5, 1023.5, 2112, 2048, depth_scale=5000.0)
    metres = torch.linspace(0.1, 0.2, camera.width).expand(camera.height, -1)
    large = StaticViews(camera, 1)
    for view in make_views(4)[0]:
        large.append(replace(view, depth_units=(metres / STORED_UNIT).round().to(torch.uint16)))
    (warning,) = _check_depth_scale(large, camera)
    assert warning.startswith("half of the depth is nearer than 0.15 m")


def constant_views(constant: int, count: int, *, moving: bool = True) -> tuple[StaticViews, Trajectory]:
    """Views of which the first have a depth of 2 m at all pixels but one."""
    views, trajectory = make_views(count, moving=moving)
    changed = StaticViews(CAMERA, 2)
    for number, view in enumerate(views):
        units = torch.full((120, 160), round(2 / STORED_UNIT)).to(torch.uint16)
        units[0, 0] = 1
        changed.append(replace(view, depth_units=units) if number < constant else view)
    return changed, trajectory


@pytest.mark.parametrize(("constant", "count"), [(2, 2), (4, 4), (3, 4)])
def test_warning_about_constant_depth_and_nothing_else(constant: int, count: int) -> None:
    wrong = replace(TRUE, fx=2 * TRUE.fx, fy=2 * TRUE.fy, cx=2 * TRUE.cx, cy=2 * TRUE.cy)
    (warning,) = check(*constant_views(constant, count), make_map(wrong, noise=0.3), wrong)
    assert warning.startswith("the depth is 2 m at nearly all pixels of an image")


@pytest.mark.parametrize(
    ("constant", "of", "moving"),
    [
        (2, 4, True),  # half of the views
        (1, 1, True),
        (4, 4, False),  # a plane in front of a camera that does not turn
    ],
)
def test_constant_depth_that_can_be_true_is_not_warned_of(constant: int, of: int, moving: bool) -> None:
    warnings = check(*constant_views(constant, of, moving=moving))
    assert not any("nearly all pixels" in warning for warning in warnings)


def test_a_few_pixels_of_equal_depth_are_not_warned_of() -> None:
    views, trajectory = make_views(4)
    sparse = StaticViews(CAMERA, 2)
    for view in views:
        units = torch.zeros(120, 160).to(torch.uint16)
        units[5, 5:25] = round(2 / STORED_UNIT)
        sparse.append(replace(view, depth_units=units))
    assert check(sparse, trajectory) == []
