"""The system as a researcher calls it: one line to make it, one to take in a frame, stages that can be replaced."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from PIL import Image

from v3d_torch import V3DSLAM, FrameResult, PinholeCamera, RGBDFrame, load_sequence
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.geometry.depth_smoother import DepthSmoother
from v3d_torch.geometry.se3 import invert
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.types import TrackingStatus

NO_NETWORK = load_config(None, ("segmentation.source=none",))


@pytest.fixture(scope="module")
def demo() -> RGBDSequence:
    return load_sequence("demo")


def test_frames_bring_their_camera_and_poses_come_back(demo: RGBDSequence) -> None:
    slam = V3DSLAM(config=NO_NETWORK)
    for index in range(3):
        pose = slam(demo[index])
        assert isinstance(pose, FrameResult)
        assert pose.stamp == float(demo.stamps[index])
        assert pose.T_wc.shape == (4, 4) and pose.T_wc.dtype == torch.float64
        assert torch.equal(pose.T_wc, invert(slam.poses.T_cw))
        assert pose.status is TrackingStatus.TRACKED
        assert pose.static_mask.shape == (480, 640) and pose.objects == []


def test_a_camera_given_or_carried_gives_the_same(demo: RGBDSequence) -> None:
    given = V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    carried = V3DSLAM(config=NO_NETWORK)
    for index in range(3):
        assert torch.equal(given(demo[index]).T_wc, carried(demo[index]).T_wc)


def test_arrays_as_opencv_gives_them_give_the_same(demo: RGBDSequence) -> None:
    stored, from_arrays = V3DSLAM(config=NO_NETWORK), V3DSLAM(config=NO_NETWORK)
    for index in range(3):
        frame = demo[index]
        image = frame.image.permute(1, 2, 0).numpy()
        metres = frame.depth[0].numpy().astype(np.float64)
        metres[metres == 0] = np.nan
        made = RGBDFrame.from_arrays(index, frame.stamp, image, metres, demo.camera)
        assert torch.equal(made.image, frame.image) and torch.equal(made.depth, frame.depth)
        assert torch.equal(stored(frame).T_wc, from_arrays(made).T_wc)


def test_depth_in_the_cameras_units_becomes_metres(demo: RGBDSequence) -> None:
    image = torch.zeros(480, 640, 3, dtype=torch.uint8)
    units = np.full((480, 640), 5000, np.uint16)
    assert (
        RGBDFrame.from_arrays(0, 0.0, image, units, demo.camera).depth.unique().item() == 5000 / demo.camera.depth_scale
    )
    assert RGBDFrame.from_arrays(0, 0.0, image, units).depth.unique().item() == 5.0
    assert RGBDFrame.from_arrays(0, 0.0, image, torch.full((480, 640), -1.0)).depth.unique().item() == 0.0


@pytest.mark.parametrize(
    ("image", "depth"),
    [
        (np.zeros((48, 64), np.uint8), np.ones((48, 64))),
        (np.zeros((3, 48, 64), np.uint8), np.ones((48, 64))),
        (np.zeros((48, 64, 3), np.float32), np.ones((48, 64))),
        (np.zeros((48, 64, 3), np.uint8), np.ones((1, 48, 64))),
        (np.zeros((48, 64, 3), np.uint8), np.ones((64, 48))),
    ],
    ids=["grey", "channels first", "float colour", "depth with a channel", "depth of another size"],
)
def test_arrays_of_another_shape_or_type_are_refused(image: np.ndarray, depth: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"frame 7: .*; give "):
        RGBDFrame.from_arrays(7, 0.0, image, depth)


def test_images_as_other_libraries_give_them(demo: RGBDSequence) -> None:
    frame = demo[0]
    rgb, metres = frame.image.permute(1, 2, 0).numpy(), frame.depth[0]
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    for image, depth in (
        (bgr[..., ::-1], metres),  # OpenCV's, the usual way round
        (rgb[:, ::-1][:, ::-1], metres.numpy()[:, ::-1][:, ::-1]),
        (Image.fromarray(rgb), Image.fromarray(metres.numpy())),
        (torch.from_numpy(rgb), metres.clone().requires_grad_()),  # a network's
    ):
        made = RGBDFrame.from_arrays(0, frame.stamp, image, depth, demo.camera)
        assert torch.equal(made.image, frame.image) and torch.equal(made.depth, frame.depth)
    half = RGBDFrame.from_arrays(0, 0.0, rgb, metres.to(torch.bfloat16), demo.camera)
    torch.testing.assert_close(half.depth, frame.depth, rtol=4e-3, atol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": None}, "the colour image is object of shape "),
        ({"image": "rgb.png"}, "the colour image is <U7 of shape "),
        ({"depth": np.ones((480, 640), bool)}, "the depth image is bool; give metres"),
        ({"depth": np.ones((480, 640), complex)}, "the depth image is complex128; give metres"),
        ({"stamp": math.nan}, "the stamp is nan; give seconds"),
        ({"stamp": None}, "the stamp is None; give seconds"),
        ({"delay": math.inf}, "the delay is inf; give seconds"),
        ({"camera": np.eye(3)}, "the camera is a ndarray; give a PinholeCamera"),
        (
            {"camera": PinholeCamera(260.0, 260.0, 159.5, 119.5, 320, 240)},
            "has 640x480 pixels, the camera 320x240; give the camera that took it",
        ),
    ],
)
def test_what_is_no_frame_is_said(change: dict[str, object], message: str) -> None:
    given = {"stamp": 0.0, "image": np.zeros((480, 640, 3), np.uint8), "depth": np.ones((480, 640))} | change
    with pytest.raises(InputError, match=f"^frame 7: {message}"):
        RGBDFrame.from_arrays(7, **given)


def test_without_any_camera_it_says_so(demo: RGBDSequence) -> None:
    frame = demo[0]
    with pytest.raises(ConfigError, match="camera"):
        V3DSLAM(config=NO_NETWORK)(RGBDFrame(0, 0.0, frame.image, frame.depth))


@pytest.mark.parametrize("known", [True, False], ids=["camera given", "camera in the frames"])
def test_a_stage_can_be_replaced_at_any_time(demo: RGBDSequence, known: bool) -> None:
    slam = V3DSLAM(demo.camera if known else None, NoSegmentation(), NO_NETWORK)
    seen = []
    smooth = slam.smooth_depth if known else DepthSmoother(5, 1.0, 0.05)
    slam.smooth_depth = lambda depth: seen.append(depth.shape) or smooth(depth)  # type: ignore[assignment,func-returns-value]
    slam(demo[0])
    assert seen == [(1, 1, 480, 640)]


def test_arrays_instead_of_a_frame_are_refused(demo: RGBDSequence) -> None:
    with pytest.raises(InputError, match=r"this is a ndarray; .* RGBDFrame\.of"):
        V3DSLAM(demo.camera, config=NO_NETWORK)(np.zeros((480, 640, 3), np.uint8))


def test_a_map_that_drops_what_nobody_needs_tracks_the_same_to_the_bit(
    demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Landmarks that are dead and that nobody refers to go; the others get other ids, and nothing else changes."""
    runs = {}
    for name, worth in (("never", math.inf), ("with every keyframe", 0)):
        monkeypatch.setattr("v3d_torch.mapping.landmark_ids._MAX_LANDMARKS_PER_OBSERVATION", worth)
        slam = V3DSLAM(demo.camera, config=load_config(None, ("segmentation.source=none",)))
        for index in range(60):
            slam(demo[index])
        slam.flush()
        runs[name] = slam
    packed, whole = runs["with every keyframe"].mapper.map, runs["never"].mapper.map
    assert len(packed.keyframes) == len(whole.keyframes) > 3
    assert len(packed.landmarks) < 0.9 * len(whole.landmarks)
    assert torch.equal(*(slam.poses.trajectory().T_wc for slam in runs.values()))
    for name, column in packed.landmarks.columns.items():
        assert torch.equal(column[packed.landmarks["active"]], whole.landmarks[name][whole.landmarks["active"]])
    places = [known.landmarks["point"][known.observations["landmark"]] for known in (packed, whole)]
    assert torch.equal(*places)
