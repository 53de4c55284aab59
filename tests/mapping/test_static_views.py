"""Static views: undistortion, precision of depth, and their state."""

from __future__ import annotations

import pytest
import torch
from helpers.box_room import CAMERA, EYE, keyframe
from kornia.core.exceptions import ShapeError

from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.camera import PinholeCamera, back_project
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.mapping.static_views import StaticViews

ALL = torch.ones(240, 320, dtype=torch.bool)
GREY = torch.full((3, 240, 320), 128, dtype=torch.uint8)


def test_distortion_is_removed() -> None:
    """Points lie on the rays of the distorted camera, and the pinhole projects them to their pixels."""
    camera = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    views = StaticViews(camera, 2)
    v, u = torch.meshgrid(torch.arange(480), torch.arange(640), indexing="ij")
    depth = 1 + 0.001 * (u + v)[None].float()
    views.add(keyframe(), torch.zeros(3, 480, 640, dtype=torch.uint8), depth, torch.ones(480, 640, dtype=torch.bool))
    (view,) = views
    valid = view.depth > 0
    points = back_project(view.depth[None, None], views.rays)[0]
    pixels = views.camera.project(points[valid].double())
    row, column = torch.nonzero(valid).double().unbind(dim=1)
    assert (pixels - torch.stack([column, row], dim=1)).abs().max() < 0.26  # half a pixel of the image
    expected = back_project(depth[None], camera.rays)[0].reshape(-1, 3)
    sample = torch.randint(0, int(valid.sum()), (300,), generator=torch.Generator().manual_seed(0))
    assert torch.cdist(points[valid][sample].double(), expected.double()).amin(dim=1).max() < 2e-4
    assert valid.double().mean() > 0.94  # in the corners this lens covers less than the pinhole


def test_depth_is_stored_with_a_tenth_of_a_millimetre() -> None:
    depth = 0.5 + 15 * torch.rand(1, 240, 320, generator=torch.Generator().manual_seed(0))
    views = StaticViews(CAMERA, 1)
    views.add(keyframe(EYE), GREY, depth, ALL)
    (view,) = views
    near = depth[0] < 13
    assert (view.depth - depth[0])[near].abs().max() < 1.1e-4
    assert (view.depth[depth[0] > 13.2] == 0).all()


@pytest.mark.parametrize("wrong", ["image", "depth", "static"])
def test_images_of_another_size_than_the_camera_are_rejected(wrong: str) -> None:
    """The upper left part of a larger image was stored."""
    images = {"image": GREY, "depth": torch.ones(1, 240, 320), "static": ALL}
    images[wrong] = images[wrong].repeat_interleave(2, dim=-1).repeat_interleave(2, dim=-2)
    with pytest.raises(ShapeError):
        StaticViews(CAMERA, 2).add(keyframe(EYE), **images)


def test_mask_that_is_not_bool_and_stride_below_one_are_rejected() -> None:
    with pytest.raises(InputError, match=r"^static has the type torch\.uint8; give a mask of type torch\.bool$"):
        StaticViews(CAMERA, 2).add(keyframe(EYE), GREY, torch.ones(1, 240, 320), ALL.to(torch.uint8))
    for stride in (0, -1):
        with pytest.raises(ConfigError, match=f"^stride is {stride}; give a number of pixels of at least 1$"):
            StaticViews(CAMERA, stride)


def test_pose_of_the_depth_is_that_at_its_time() -> None:
    T_dc = se3_exp(torch.tensor([0.004, -0.002, 0.001, 0.005, 0.01, -0.007], dtype=torch.float64))
    own = keyframe(se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.1, 0.2, 0.3], dtype=torch.float64)))
    views = StaticViews(CAMERA, 2)
    views.add(own, GREY, torch.ones(1, 240, 320), ALL, 0.012, T_dc)
    (view,) = views
    torch.testing.assert_close(view.T_dw, T_dc @ own.T_cw)
    torch.testing.assert_close(view.T_wd @ view.T_dw, EYE)
    views.add(own, GREY, torch.ones(1, 240, 320), ALL, 0.012)
    assert torch.equal(list(views)[1].T_dw, own.T_cw)  # a camera at rest


def test_views_with_the_state_of_other_views_continue_like_them() -> None:
    original, restored = StaticViews(CAMERA, 2), StaticViews(CAMERA, 2)
    first, second, third = (keyframe(EYE, frame) for frame in range(3))
    for own in (first, second):
        original.add(own, GREY, torch.full((1, 240, 320), 1.0 + own.frame), ALL)
    restored.load_state_dict({name: list(views) for name, views in original.state_dict().items()})
    assert list(restored) == list(original)  # the same objects
    first.reference = 1  # culled
    for views in (original, restored):
        views.add(third, GREY, torch.full((1, 240, 320), 3.0), ALL)
        assert [view.keyframe for view in views] == [second, third]
    for ours, other in zip(original, restored, strict=True):
        assert torch.equal(ours.depth, other.depth) and torch.equal(ours.colour, other.colour)


def test_view_of_a_culled_keyframe_is_left_out_also_if_no_view_is_added_later() -> None:
    """The last keyframes of a run are culled after the last view was added."""
    views, keyframes = StaticViews(CAMERA, 2), [keyframe(EYE, frame) for frame in range(3)]
    for own in keyframes:
        views.add(own, GREY, torch.ones(1, 240, 320), ALL)
    keyframes[1].reference = 0  # culled
    kept = [keyframes[0], keyframes[2]]
    assert [view.keyframe for view in views] == [view.keyframe for view in views.own] == kept
    assert len(views) == 2


def test_connected_views_leave_out_disconnected_keyframes() -> None:
    views = StaticViews(CAMERA, 2)
    here, elsewhere = keyframe(EYE, 0), keyframe(EYE, 1)
    for own in (here, elsewhere):
        views.add(own, GREY, torch.full((1, 240, 320), 1.0), ALL)
    elsewhere.part = 1
    assert [view.keyframe for view in views.connected()] == [here] and len(views) == 2
    elsewhere.part = 0  # a loop joined the parts
    assert [view.keyframe for view in views.connected()] == [here, elsewhere]
