"""Dense alignment of rendered and real images: blur, low light, fast rotations, comparison with Open3D."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.demo_frames import copy_frames
from helpers.rendered_planes import Image, align, motion_error
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from v3d_torch.datasets import TUMSequence
from v3d_torch.geometry.depth_smoother import smooth_depth
from v3d_torch.geometry.se3 import invert, se3_log


def load(sequence: TUMSequence, index: int) -> Image:
    frame = sequence[index]
    grey = cv2.cvtColor(frame.image.permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
    return torch.from_numpy(grey)[None] / 255, smooth_depth(frame.depth[None])[0]


def blurred(image: Image) -> Image:
    return torch.from_numpy(cv2.GaussianBlur(image[0][0].numpy(), (0, 0), 4))[None], image[1]


def motion_blurred(image: Image) -> Image:
    """Image blurred by a rotation during exposure, 21 pixels along the rows."""
    return torch.from_numpy(cv2.blur(image[0][0].numpy(), (21, 1)))[None], image[1]


def darkened(image: Image) -> Image:
    """8-bit image with a tenth of the light and noise of two brightness steps."""
    noise = torch.randn(image[0].shape, generator=torch.Generator().manual_seed(3))
    return (25.5 * image[0] + 2 * noise).round().clamp(0, 255) / 255, image[1]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[TUMSequence, list[Tensor]]:
    """Frames 40, 43 and 46 of the demo, and their masks of static pixels."""
    folder = tmp_path_factory.mktemp("demo")
    copy_frames(folder, range(40, 49, 3))
    masks = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((folder / "masks").iterdir())]
    static = [torch.from_numpy(cv2.dilate(mask, np.ones((9, 9), np.uint8)) == 0) for mask in masks]
    return TUMSequence(folder), static


@pytest.mark.parametrize(
    ("change", "millimetres", "degrees"),
    [(None, 0.6, 0.02), (blurred, 4.0, 0.1), (motion_blurred, 4.0, 0.1), (darkened, 4.0, 0.1)],
)
def test_motion_between_frames_of_the_demo(
    demo: tuple[TUMSequence, list[Tensor]],
    change: Callable[[Image], Image] | None,
    millimetres: float,
    degrees: float,
) -> None:
    sequence, static = demo
    assert sequence.groundtruth is not None
    T_wc = sequence.groundtruth.T_wc
    for a, b in ((0, 1), (1, 2)):
        T_ba = invert(T_wc[b]) @ T_wc[a]
        assert 1e3 * float(T_ba[:3, 3].norm()) > 10 * millimetres / 4  # the motion is larger than the tolerance
        view = load(sequence, b)
        alignment = align(
            load(sequence, a),
            view if change is None else change(view),
            camera=sequence.camera,
            static=(static[a], static[b]),
        )
        error = motion_error(alignment, T_ba)
        assert error[0] < millimetres and error[1] < degrees, error


@pytest.fixture(scope="module")
def fr1_rpy(real_sequence: Callable[[str], Path]) -> tuple[TUMSequence, Tensor]:
    """TUM's fr1_rpy and the true pose T_wc of each frame; its colour stamps lag 12 ms behind the motion capture."""
    sequence = TUMSequence(real_sequence("fr1_rpy"))
    truth = sequence.groundtruth
    assert truth is not None
    true_stamps = truth.stamps.numpy()
    stamps = np.clip(sequence.stamps.numpy() - 0.012, true_stamps[0], true_stamps[-1])
    T_wc = np.tile(np.eye(4), (len(stamps), 1, 1))
    T_wc[:, :3, :3] = Slerp(true_stamps, Rotation.from_matrix(truth.T_wc[:, :3, :3].numpy()))(stamps).as_matrix()
    for axis in range(3):
        T_wc[:, axis, 3] = np.interp(stamps, true_stamps, truth.T_wc[:, axis, 3].numpy())
    return sequence, torch.from_numpy(T_wc)


def motion_errors(
    fr1_rpy: tuple[TUMSequence, Tensor], frames: list[int], change: Callable[[Image], Image], gap: int = 1
) -> Tensor:
    """Errors of the motion to the frame ``gap`` later, whose image is changed; millimetres and degrees, (N, 2)."""
    sequence, T_wc = fr1_rpy
    alignments = [align(load(sequence, i), change(load(sequence, i + gap))) for i in frames]
    T_ba = [invert(T_wc[i + gap]) @ T_wc[i] for i in frames]
    return torch.tensor([motion_error(*pair) for pair in zip(alignments, T_ba, strict=True)])


FASTEST = list(range(112, 118))
"""Frames with rotations of 3 to 6 degrees and motion blur; few features match."""


def test_fast_rotations_of_a_real_camera(fr1_rpy: tuple[TUMSequence, Tensor]) -> None:
    errors = motion_errors(fr1_rpy, FASTEST, lambda image: image)
    assert errors[:, 0].max() < 20 and errors[:, 1].max() < 1.2
    assert errors[:, 0].square().mean().sqrt() < 10 and errors[:, 1].square().mean().sqrt() < 0.7


@pytest.mark.parametrize("change", [blurred, motion_blurred, darkened])
def test_real_images_with_blur_or_low_light(
    fr1_rpy: tuple[TUMSequence, Tensor], change: Callable[[Image], Image]
) -> None:
    errors = motion_errors(fr1_rpy, [30, 200, 300, 550], change)
    assert errors[:, 0].square().mean().sqrt() < 8 and errors[:, 1].square().mean().sqrt() < 0.5


def test_real_images_three_frames_apart_with_low_light(fr1_rpy: tuple[TUMSequence, Tensor]) -> None:
    """The motion is so large that gain and bias must be correct from the first step on."""
    errors = motion_errors(fr1_rpy, [63, 339], darkened, gap=3)
    assert errors[:, 0].max() < 10 and errors[:, 1].max() < 1.0


def test_real_views_too_far_apart_give_none(fr1_rpy: tuple[TUMSequence, Tensor]) -> None:
    sequence, T_wc = fr1_rpy
    for a, b in ((100, 130), (300, 340), (420, 450), (600, 640)):
        assert float(se3_log(invert(T_wc[b]) @ T_wc[a])[3:].norm()) > 0.2
        assert align(load(sequence, a), load(sequence, b)) is None


def test_alignment_is_at_least_as_accurate_as_open3d(fr1_rpy: tuple[TUMSequence, Tensor]) -> None:
    # ImportError also covers a missing system library.
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    sequence, T_wc = fr1_rpy
    camera = sequence.camera
    K, distortion = camera.K.numpy(), np.array(camera.distortion)
    maps = cv2.initUndistortRectifyMap(K, distortion, None, K, (camera.width, camera.height), cv2.CV_32FC1)

    def undistorted(index: int) -> object:
        grey, depth = (image[0].numpy() for image in load(sequence, index))
        return o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(cv2.remap(grey, *maps, cv2.INTER_LINEAR)),
            o3d.geometry.Image(cv2.remap(depth, *maps, cv2.INTER_NEAREST)),
            depth_scale=1.0,
            depth_trunc=8.0,
            convert_rgb_to_intensity=False,
        )

    frames = [20, 115, 240, 320, 520, 640]
    intrinsics = o3d.camera.PinholeCameraIntrinsic(640, 480, camera.fx, camera.fy, camera.cx, camera.cy)
    open3d_errors = []
    for i in frames:
        ok, T_ba, _ = o3d.pipelines.odometry.compute_rgbd_odometry(
            undistorted(i),
            undistorted(i + 1),
            intrinsics,
            np.eye(4),
            o3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(),
            o3d.pipelines.odometry.OdometryOption(depth_max=8.0),
        )
        assert ok
        error = torch.from_numpy(np.array(T_ba)) @ invert(invert(T_wc[i + 1]) @ T_wc[i])
        open3d_errors.append((1e3 * float(error[:3, 3].norm()), float(torch.rad2deg(se3_log(error)[3:].norm()))))
    errors = motion_errors(fr1_rpy, frames, lambda image: image)
    limit = 1.1**2 * torch.tensor(open3d_errors).square().mean(dim=0)
    assert (errors.square().mean(dim=0) <= limit).all(), (errors, open3d_errors)
