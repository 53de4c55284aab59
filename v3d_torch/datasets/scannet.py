"""Folders exported by ScanNet's SensReader (Dai et al., CVPR 2017): one file per image and pose, two cameras."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.broken_frames import first_readable
from v3d_torch.datasets.camera_fields import camera_from_matrix, check_principal_point
from v3d_torch.datasets.cameras import CameraChoice, camera_file
from v3d_torch.datasets.colour_warp import scale_matrix, warp_colour
from v3d_torch.datasets.image_files import frame_number, list_images, pair_by_number
from v3d_torch.datasets.images import image_size
from v3d_torch.datasets.lists import ImagePair
from v3d_torch.datasets.matrix_files import read_matrix, read_poses
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera

_RATE = 30.0
"""Frame rate, Hz. File numbers are the sensor's frame numbers, even if an export skips frames."""

_DEPTH_SCALE = 1000.0
"""Depth units per metre."""


class ScanNetSequence(PairedImages):
    """Sequence with ``color/0.jpg``, ``depth/0.png``, ``pose/0.txt`` and ``intrinsic/``.

    Colour images are larger than depth images and have their own camera at the same position. Each colour image is
    warped to the pixels of the depth image. Poses that are not finite (tracking was lost) are left out of the ground
    truth.

    Args:
        folder: Folder of the sequence, or its parent if the sequence is in a subfolder ``frames``.
        camera: Camera of the depth images, chosen by the user; None for the ``camera.yaml`` or ``K.txt`` in
            either folder, else ``intrinsic_depth.txt``.

    Raises:
        InputError: If a file is missing or invalid.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        frames = _frames_folder(folder)
        pairs, note = pair_by_number(frames, list_images(frames / "color"), list_images(frames / "depth"), _RATE)
        stamps = {round(pair.stamp * _RATE): pair.stamp for pair in pairs}
        pose_files = {frame_number(path): path for path in frames.glob("pose/*.txt")}
        super().__init__(
            frames,
            pairs,
            camera if camera is not None else camera_file(folder),
            lambda: read_poses({stamp: pose_files[number] for number, stamp in stamps.items() if number in pose_files}),
            published=lambda: first_readable(partial(_depth_camera, frames), pairs),
            depth_scale=_DEPTH_SCALE,
            name=folder.resolve().name,
            pairing_note=note,
        )
        self._colour_camera = colour = _intrinsics_file(frames, "color")
        self._K_colour = _read_camera_matrix(colour)[:3, :3] if colour is not None else None

    @staticmethod
    def _image_size(folder: Path, pair: ImagePair) -> tuple[int, int]:
        return image_size(folder / pair.depth)

    def _read_colour(self, index: int) -> Tensor:
        """Read a colour image and warp it to the depth camera."""
        colour = super()._read_colour(index)
        height, width = colour.shape[1:]
        size = (self.camera.width, self.camera.height)
        if (width, height) == size:
            return colour
        K_depth = self.camera.K.numpy()
        K_colour = (
            self._K_colour if self._K_colour is not None else scale_matrix(K_depth, width / size[0], height / size[1])
        )
        if self._colour_camera is not None:
            check_principal_point(K_colour[0, 2], K_colour[1, 2], (width, height), self._colour_camera)
        return warp_colour(colour, K_colour, K_depth, size)


def is_scannet(path: Path) -> bool:
    """Check whether a folder contains colour and depth, and poses or cameras, under the names of ScanNet's export."""
    frames = _frames_folder(path)
    images = (frames / "color").is_dir() and (frames / "depth").is_dir()
    return images and ((frames / "pose").is_dir() or any(_intrinsics_file(frames, kind) for kind in ("color", "depth")))


def _frames_folder(folder: Path) -> Path:
    return folder / "frames" if (folder / "frames" / "color").is_dir() else folder


def _intrinsics_file(frames: Path, kind: str) -> Path | None:
    """Camera file of the ``color`` or ``depth`` images, in any of the usual locations."""
    names = (f"intrinsic/intrinsic_{kind}.txt", f"intrinsic_{kind}.txt", f"intrinsics_{kind}.txt")
    return next((frames / name for name in names if (frames / name).is_file()), None)


def _depth_camera(frames: Path, pair: ImagePair) -> PinholeCamera | None:
    """Camera of the depth images. Without its file: the colour camera, scaled to the size of the depth images."""
    width, height = image_size(frames / pair.depth)
    source = _intrinsics_file(frames, "depth") or _intrinsics_file(frames, "color")
    if source is None:
        return None
    K = _read_camera_matrix(source)
    if source == _intrinsics_file(frames, "color"):
        colour_size = image_size(frames / pair.colour)
        check_principal_point(K[0, 2], K[1, 2], colour_size, source)
        K = scale_matrix(K, width / colour_size[0], height / colour_size[1])
    return camera_from_matrix(K, (width, height), _DEPTH_SCALE, source)


def _read_camera_matrix(path: Path) -> NDArray[np.float64]:
    """Read a camera matrix, shape (3, 3) or (4, 4)."""
    K = read_matrix(path)
    if not (np.isfinite(K).all() and K[0, 0] >= 1 and K[1, 1] >= 1):
        raise InputError(
            f"{path}: is not a camera matrix with focal lengths of at least 1 pixel on its diagonal; copy it again"
        )
    return K
