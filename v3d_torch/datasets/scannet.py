"""Folders as ScanNet's reader exports them (Dai et al., CVPR 2017): a file per image and pose, two cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.cameras import CameraChoice, checked_camera, choose_camera
from v3d_torch.datasets.file_names import frame_number, images_in, numbered_pairs
from v3d_torch.datasets.images import image_size, read_colour
from v3d_torch.datasets.lists import ImagePair
from v3d_torch.datasets.matrices import read_matrix, read_poses
from v3d_torch.datasets.paired import PairedImages
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera

_RATE = 30.0
"""Frames a second: the files are numbered as the sensor counted, also where an export left some out."""

_DEPTH_SCALE = 1000.0
"""Units per metre."""


class ScanNetSequence(PairedImages):
    """Frames of a folder with ``color/0.jpg``, ``depth/0.png``, ``pose/0.txt`` and ``intrinsic/``.

    Colour is larger than depth and its camera is another, at the same place: each colour image is brought to the
    pixels of the depth image. Poses that are not finite (tracking was lost) are left out of the ground truth.

    Args:
        folder: of these, or of ``frames`` with these in it.
        camera: the user's choice for the depth images; None takes ``intrinsic_depth.txt``.

    Raises:
        InputError: a file is missing or wrong.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        frames = _frames(folder)
        pairs = numbered_pairs(frames, images_in(frames / "color"), images_in(frames / "depth"), _RATE)
        numbers = {round(pair.stamp * _RATE): pair.stamp for pair in pairs}
        poses = {frame_number(path): path for path in frames.glob("pose/*.txt")}
        published = None if camera is not None else _depth_camera(frames, pairs[0])
        super().__init__(
            frames,
            pairs,
            choose_camera(camera, frames, published),
            lambda: read_poses({stamp: poses[number] for number, stamp in numbers.items() if number in poses}),
            name=folder.resolve().name,
        )
        colour = _intrinsics(frames, "color")
        self._K_colour = _checked(read_matrix(colour), colour)[:3, :3] if colour is not None else None

    def _colour(self, path: Path) -> Tensor:
        """The colour image as the depth camera would have seen it."""
        colour = read_colour(path)
        height, width = colour.shape[1:]
        size = (self.camera.width, self.camera.height)
        if (width, height) == size:
            return colour
        K_depth = self.camera.K.numpy()
        K_colour = self._K_colour if self._K_colour is not None else _scaled(K_depth, width / size[0], height / size[1])
        # Averaged down to about the depth image's scale first, which keeps fine texture from turning into noise, then
        # moved by fractions of a pixel, so that the pixels of both images look along the same rays.
        shrink = K_depth.diagonal()[:2] / K_colour.diagonal()[:2]
        near = np.maximum(np.rint(np.array([width, height]) * shrink), 1).astype(int).tolist()
        small = cv2.resize(colour.permute(1, 2, 0).numpy(), near, interpolation=cv2.INTER_AREA)
        K_small = _scaled(K_colour, near[0] / width, near[1] / height)
        small_from_depth = (K_small @ np.linalg.inv(K_depth))[:2]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        pixels = cv2.warpAffine(small, small_from_depth, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return torch.from_numpy(pixels).permute(2, 0, 1)


def is_scannet(path: Path) -> bool:
    """Whether a folder holds colour, depth and poses or cameras as ScanNet's reader names them."""
    frames = _frames(path)
    images = (frames / "color").is_dir() and (frames / "depth").is_dir()
    return images and ((frames / "pose").is_dir() or any(_intrinsics(frames, kind) for kind in ("color", "depth")))


def _frames(folder: Path) -> Path:
    return folder / "frames" if (folder / "frames" / "color").is_dir() else folder


def _intrinsics(frames: Path, kind: str) -> Path | None:
    """The file with the camera of ``color`` or ``depth``, wherever the usual exports put it."""
    names = (f"intrinsic/intrinsic_{kind}.txt", f"intrinsic_{kind}.txt", f"intrinsics_{kind}.txt")
    return next((frames / name for name in names if (frames / name).is_file()), None)


def _depth_camera(frames: Path, pair: ImagePair) -> PinholeCamera | None:
    """The depth images' camera; without a file of it the colour images' one, which has the same view, scaled."""
    width, height = image_size(frames / pair.depth)
    source = _intrinsics(frames, "depth") or _intrinsics(frames, "color")
    if source is None:
        return None
    K = _checked(read_matrix(source), source)
    if source == _intrinsics(frames, "color"):
        full = image_size(frames / pair.colour)
        K = _scaled(K, width / full[0], height / full[1])
    fields = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": width, "height": height}
    return checked_camera(fields | {"depth_scale": _DEPTH_SCALE}, str(source))


def _checked(K: NDArray[np.float64], source: Path) -> NDArray[np.float64]:
    """A camera matrix, if it is one."""
    if not (np.isfinite(K).all() and K[0, 0] >= 1 and K[1, 1] >= 1):
        raise InputError(f"{source}: is no camera matrix, with focal lengths on its diagonal; copy it again")
    return K


def _scaled(K: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """Camera matrix of an image that is resized; pixel centres lie at integers, so its edges at -0.5."""
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return np.diag([x, y, 1.0]) @ (K[:3, :3] + half) - half
