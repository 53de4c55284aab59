"""ScanNet exports: colour warped to the depth camera, lost poses skipped, timestamps from frame numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.damaged_folders import assert_ground_truth_is_left_out, assert_rejected
from helpers.tiny_images import colour_of, depth_of, save
from numpy.typing import NDArray

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.scannet import ScanNetSequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera

FULL, SIZE = (260, 193), (128, 96)
"""Sizes of colour and depth images with the aspect ratios of ScanNet: colour is cropped at top and bottom."""
K_COLOUR = np.array([[234.0, 0, 131.0], [0, 234.5, 97.0], [0, 0, 1]])
K_DEPTH = np.array([[115.5, 0, 63.0], [0, 115.6, 48.5], [0, 0, 1]])
LOST = "-inf -inf -inf -inf\n" * 4
IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


def rays(K: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Normalised coordinates (x, y) of every pixel, shape (H, W, 2)."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1)


def render(K: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Render a wall whose channels are a ramp to the right, a ramp downwards, and waves."""
    x, y = np.moveaxis(rays(K, size), -1, 0)
    return np.stack([128 + 215 * x, 128 + 280 * y, 128 + 100 * np.sin(20 * x) * np.cos(20 * y)], axis=-1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "scene0000_00"
    for number in (0, 20, 100):
        save(root / "color" / f"{number}.png", render(K_COLOUR, FULL).round().clip(0, 255).astype(np.uint8))
        save(root / "depth" / f"{number}.png", depth_of(number, *SIZE))
        (root / "pose").mkdir(exist_ok=True)
        (root / "pose" / f"{number}.txt").write_text(LOST if number == 20 else IDENTITY.replace("0\n", "2\n", 1))
    (root / "intrinsic").mkdir()
    for kind, K in (("color", K_COLOUR), ("depth", K_DEPTH)):
        np.savetxt(root / "intrinsic" / f"intrinsic_{kind}.txt", np.block([[K, np.zeros((3, 1))], [0, 0, 0, 1]]))
    return root


@pytest.mark.parametrize("nested", [False, True])
def test_scannet_frames_match_files(folder: Path, nested: bool) -> None:
    if nested:
        folder = folder.rename(folder.with_name("frames")).parent
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, ScanNetSequence)
    assert sequence.name == folder.name
    assert sequence.stamps.tolist() == [0, 20 / 30, 100 / 30]
    assert sequence.camera == PinholeCamera(115.5, 115.6, 63.0, 48.5, *SIZE, depth_scale=1000)
    np.testing.assert_allclose(sequence[2].depth[0], depth_of(100, *SIZE) / 1000, rtol=1e-6)
    assert sequence.groundtruth is not None
    assert sequence.groundtruth.stamps.tolist() == [0, 100 / 30]
    assert sequence.groundtruth.T_wc[1, :3, 3].tolist() == [2, 0, 0]


def test_colour_images_without_depth_are_left_out_with_a_note(folder: Path) -> None:
    (folder / "depth" / "100.png").unlink()
    save(folder / "color" / "thumbnail.png", colour_of(1))  # has no number, so that it is no frame
    sequence = load_sequence(folder)
    assert isinstance(sequence, ScanNetSequence) and len(sequence) == 2
    assert sequence.notes == [
        "1 of 2 poses of the ground truth are empty or not finite and are left out",
        "1 of 3 colour images have no depth image of the same frame number and are left out (the last is 100.png)",
    ]


def test_warped_colour_has_the_rays_of_the_depth_camera(folder: Path) -> None:
    """The tolerance is a fraction of a grey level; on the ramps, 0.1 pixels are 0.2 grey levels."""
    image = load_sequence(str(folder))[0].image
    error = image.permute(1, 2, 0).numpy() - render(K_DEPTH, SIZE)
    inside = error[2:-2, 2:-2]
    assert np.abs(inside[..., :2]).max() < 1.5  # three roundings
    assert np.abs(inside[..., :2].mean(axis=(0, 1))).max() < 0.1
    assert np.abs(inside[..., 2]).max() < 4


def test_fine_texture_is_averaged_in_smaller_images(folder: Path) -> None:
    u, v = np.meshgrid(np.arange(FULL[0]), np.arange(FULL[1]))
    board = np.repeat(((u + v) % 2 * 255).astype(np.uint8)[..., None], 3, axis=-1)
    save(folder / "color" / "0.png", board)
    image = load_sequence(str(folder))[0].image.numpy()
    assert np.abs(image.astype(float) - 127.5).max() < 40


def test_colour_of_the_depth_size_is_unchanged(folder: Path) -> None:
    save(folder / "color" / "0.png", colour_of(0, *SIZE))
    assert np.array_equal(load_sequence(str(folder))[0].image.permute(1, 2, 0).numpy(), colour_of(0, *SIZE))


def test_resized_colour_images_need_the_camera_of_their_size(folder: Path) -> None:
    for path in (folder / "color").iterdir():
        save(path, colour_of(0, 64, 48))
    message = r"intrinsic_color\.txt: the principal point \(131, 97\) is far from the centre of the 64x48 images; give"
    with pytest.raises(InputError, match=message):
        load_sequence(str(folder))[0]
    (folder / "intrinsic" / "intrinsic_depth.txt").unlink()
    with pytest.raises(InputError, match=message):
        load_sequence(str(folder))


def test_missing_depth_camera_is_derived_from_colour_camera(folder: Path) -> None:
    (folder / "intrinsic" / "intrinsic_depth.txt").unlink()
    camera = load_sequence(str(folder)).camera
    ratio = SIZE[0] / FULL[0]
    assert (camera.fx, camera.cx) == pytest.approx((234 * ratio, 131.5 * ratio - 0.5))
    image = load_sequence(str(folder))[0].image.permute(1, 2, 0).numpy()
    assert np.abs(image - render(camera.K.numpy(), SIZE))[2:-2, 2:-2, :2].max() < 1.5
    (folder / "intrinsic" / "intrinsic_color.txt").unlink()
    own = load_sequence(str(folder), camera=PinholeCamera(100, 100, 64, 48, *SIZE, depth_scale=1000))
    assert own[0].image.shape == (3, 96, 128)


@pytest.mark.parametrize("place", [".", "frames"])
def test_camera_file_beside_the_images_or_in_the_scene_is_preferred(folder: Path, place: str) -> None:
    folder = folder.rename(folder.with_name("frames")).parent
    (folder / "frames" / "intrinsic" / "intrinsic_depth.txt").write_text("a b c\n")
    (folder / place / "K.txt").write_text(f"100 101 64 48 {SIZE[0]} {SIZE[1]}\n")
    assert load_sequence(str(folder)).camera == PinholeCamera(100, 101, 64, 48, *SIZE, depth_scale=1000)


def test_sequence_without_finite_poses_has_no_ground_truth(folder: Path) -> None:
    for path in (folder / "pose").iterdir():
        path.write_text(LOST)
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, ScanNetSequence) and sequence.groundtruth is None
    assert sequence.notes == ["3 of 3 poses of the ground truth are empty or not finite and are left out"]


@pytest.mark.parametrize("text", ["", " \n", *(LOST.replace("-inf", word) for word in ("-1.#INF00", "1.#QNAN", "nan"))])
def test_empty_pose_file_or_numbers_of_windows_mark_lost_tracking(folder: Path, text: str) -> None:
    (folder / "pose" / "100.txt").write_text(text)
    sequence = load_sequence(str(folder))
    assert isinstance(sequence, ScanNetSequence) and sequence.groundtruth is not None
    assert sequence.groundtruth.stamps.tolist() == [0]
    assert sequence.notes == ["2 of 3 poses of the ground truth are empty or not finite and are left out"]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda f: (f / "intrinsic" / "intrinsic_depth.txt").write_text("a b c\n"),
            "intrinsic_depth.txt: is not a 3x3 or 4x4 matrix",
        ),
        (
            lambda f: (f / "intrinsic" / "intrinsic_depth.txt").write_text("0 0 0\n" * 3),
            "_depth.txt: is not a camera matrix",
        ),
        (lambda f: [p.unlink() for p in (f / "intrinsic").iterdir()], "has no camera parameters"),
        (
            lambda f: [p.rename(p.with_stem(f"1{p.stem}")) for p in (f / "depth").glob("*")],
            "has the same frame number as a depth",
        ),
        (lambda f: (f / "depth" / "0.png").write_bytes(b"\x89PNG"), "0.png: is not a PNG"),
    ],
)
def test_damaged_scannet_folder_is_rejected(folder: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(folder)
    assert_rejected(folder, message)


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_camera_is_known_although_the_first_frame_is_broken(folder: Path, kind: str) -> None:
    next(folder.rglob("intrinsic_depth.txt")).unlink()  # so that the sizes of both images are needed
    expected = load_sequence(str(folder)).camera
    (folder / kind / "0.png").write_bytes(b"")
    with pytest.raises(InputError, match=rf"{kind}/0\.png: is not a PNG, JPEG or TIFF image"):
        load_sequence(str(folder))
    assert load_sequence(str(folder), skip_broken=True).camera == expected


@pytest.mark.parametrize(
    ("pose", "message"),
    [("1 2 3\n", "is not a 3x3 or 4x4 matrix"), ("1 0 0\n0 1 0\n0 0 1\n", "is not a 4x4 pose matrix")],
)
def test_damaged_pose_gives_no_ground_truth(folder: Path, pose: str, message: str) -> None:
    file = next(folder.rglob("pose/0.txt"))
    file.write_text(pose)
    assert_ground_truth_is_left_out(folder, file, message)
