"""ScanNet's folders: colour brought to the depth camera's pixels, lost poses left out, numbers as times."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.tiny_images import colour_of, depth_of, save
from numpy.typing import NDArray

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.scannet import ScanNetSequence
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import GroundTruthWarning, InputError
from v3d_torch.geometry.camera import PinholeCamera

FULL, SIZE = (260, 193), (128, 96)
"""Colour and depth images, in the proportions of ScanNet's, whose colour is cut at top and bottom."""
K_COLOUR = np.array([[234.0, 0, 131.0], [0, 234.5, 97.0], [0, 0, 1]])
K_DEPTH = np.array([[115.5, 0, 63.0], [0, 115.6, 48.5], [0, 0, 1]])
LOST = "-inf -inf -inf -inf\n" * 4
IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


def rays(K: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """x and y of the ray of every pixel at unit depth, shape (H, W, 2)."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1)


def seen(K: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """What a camera sees of a wall whose colour is a steep ramp to the right, one downwards, and waves."""
    x, y = np.moveaxis(rays(K, size), -1, 0)
    return np.stack([128 + 215 * x, 128 + 280 * y, 128 + 100 * np.sin(20 * x) * np.cos(20 * y)], axis=-1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "scene0000_00"
    for number in (0, 20, 100):
        save(root / "color" / f"{number}.png", seen(K_COLOUR, FULL).round().clip(0, 255).astype(np.uint8))
        save(root / "depth" / f"{number}.png", depth_of(number, *SIZE))
        (root / "pose").mkdir(exist_ok=True)
        (root / "pose" / f"{number}.txt").write_text(LOST if number == 20 else IDENTITY.replace("0\n", "2\n", 1))
    (root / "intrinsic").mkdir()
    for kind, K in (("color", K_COLOUR), ("depth", K_DEPTH)):
        np.savetxt(root / "intrinsic" / f"intrinsic_{kind}.txt", np.block([[K, np.zeros((3, 1))], [0, 0, 0, 1]]))
    return root


@pytest.mark.parametrize("nested", [False, True])
def test_frames(folder: Path, nested: bool) -> None:
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


def test_colour_lies_on_the_rays_of_depth(folder: Path) -> None:
    """To a fraction of a grey level, where a tenth of a pixel is a fifth of a level on the ramps."""
    image = load_sequence(str(folder))[0].image
    error = image.permute(1, 2, 0).numpy() - seen(K_DEPTH, SIZE)
    inside = error[2:-2, 2:-2]
    assert np.abs(inside[..., :2]).max() < 1.5  # three roundings
    assert np.abs(inside[..., :2].mean(axis=(0, 1))).max() < 0.1
    assert np.abs(inside[..., 2]).max() < 4


def test_fine_texture_is_averaged_not_sampled(folder: Path) -> None:
    u, v = np.meshgrid(np.arange(FULL[0]), np.arange(FULL[1]))
    board = np.repeat(((u + v) % 2 * 255).astype(np.uint8)[..., None], 3, axis=-1)
    save(folder / "color" / "0.png", board)
    image = load_sequence(str(folder))[0].image.numpy()
    assert np.abs(image.astype(float) - 127.5).max() < 40


def test_images_of_one_size_are_registered(folder: Path) -> None:
    save(folder / "color" / "0.png", colour_of(0, *SIZE))
    assert np.array_equal(load_sequence(str(folder))[0].image.permute(1, 2, 0).numpy(), colour_of(0, *SIZE))


def test_one_camera_file_is_enough(folder: Path) -> None:
    (folder / "intrinsic" / "intrinsic_depth.txt").unlink()
    camera = load_sequence(str(folder)).camera
    ratio = SIZE[0] / FULL[0]
    assert (camera.fx, camera.cx) == pytest.approx((234 * ratio, 131.5 * ratio - 0.5))
    image = load_sequence(str(folder))[0].image.permute(1, 2, 0).numpy()
    assert np.abs(image - seen(camera.K.numpy(), SIZE))[2:-2, 2:-2, :2].max() < 1.5
    (folder / "intrinsic" / "intrinsic_color.txt").unlink()
    own = load_sequence(str(folder), camera=PinholeCamera(100, 100, 64, 48, *SIZE, depth_scale=1000))
    assert own[0].image.shape == (3, 96, 128)


def test_no_pose_at_all_is_no_ground_truth(folder: Path) -> None:
    for path in (folder / "pose").iterdir():
        path.write_text(LOST)
    assert load_sequence(str(folder)).groundtruth is None


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda f: (f / "intrinsic" / "intrinsic_depth.txt").write_text("a b c\n"),
            "intrinsic_depth.txt: is no matrix",
        ),
        (
            lambda f: (f / "intrinsic" / "intrinsic_depth.txt").write_text("0 0 0\n" * 3),
            "_depth.txt: is no camera",
        ),
        (lambda f: [p.unlink() for p in (f / "intrinsic").iterdir()], "says nothing about its camera"),
        (lambda f: [p.rename(p.with_stem(f"1{p.stem}")) for p in (f / "depth").glob("*")], "has the number of a depth"),
        (lambda f: (f / "depth" / "0.png").write_bytes(b"\x89PNG"), "0.png: is no image"),
    ],
)
def test_what_can_be_wrong_is_one_sentence(folder: Path, damage: Callable[[Path], object], message: str) -> None:
    damage(folder)
    with pytest.raises(InputError, match=message) as caught:
        load_sequence(str(folder))
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("pose", "message"), [("1 2 3\n", "is no matrix"), ("1 0 0\n0 1 0\n0 0 1\n", "is no 4x4 matrix")]
)
def test_a_broken_pose_costs_no_frame(folder: Path, pose: str, message: str) -> None:
    file = next(folder.rglob("pose/0.txt"))
    file.write_text(pose)
    with pytest.warns(GroundTruthWarning):
        sequence = load_sequence(str(folder))
    assert isinstance(sequence, StoredSequence) and sequence.groundtruth is None
    assert str(sequence.groundtruth_error).startswith(f"{file}: {message}")
