"""Microsoft 7-Scenes (Shotton et al., CVPR 2013), and other datasets with the same layout."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from torch import Tensor

from v3d_torch.datasets.broken_frames import first_readable
from v3d_torch.datasets.camera_fields import camera_from_matrix, check_principal_point
from v3d_torch.datasets.cameras import CameraChoice, camera_file
from v3d_torch.datasets.colour_warp import warp_colour
from v3d_torch.datasets.image_files import pair_by_number
from v3d_torch.datasets.images import image_size
from v3d_torch.datasets.lists import ImagePair
from v3d_torch.datasets.matrix_files import read_poses
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.datasets.sensor_info import SensorInfo, find_sensor_info
from v3d_torch.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, depth_scale=1000.0)
"""Published camera of the depth images of 7-Scenes. The colour images are not registered to them: there is an offset of
a few centimetres between the two sensors."""

_RATE = 30.0
"""Frame rate, Hz. File names contain frame numbers instead of timestamps."""


class SevenScenesSequence(PairedImages):
    """Sequence such as ``chess/seq-01``: ``frame-000000.color.png``, ``.depth.png``, ``.pose.txt``.

    BundleFusion, 12-Scenes and 3RScan have the same layout and an ``info.txt`` with the cameras of colour and depth.
    Each colour image is then warped to the pixels of the depth image; the few centimetres between the two cameras are
    ignored.

    Args:
        folder: Folder of the sequence.
        camera: Camera of the depth images, chosen by the user; None for the camera file in the folder, or else that of
            ``info.txt``, or else `CAMERA`.

    Raises:
        InputError: If a file is missing or invalid.
    """

    registration_fix = (
        "the data set is not supported without an info.txt that states both cameras (m_calibrationColorIntrinsic,"
        " m_calibrationDepthIntrinsic); copy it into the folder, or export depth that is registered to the colour image"
    )

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        pairs, note = pair_by_number(folder, folder.glob("frame-*.color.*"), folder.glob("frame-*.depth.*"), _RATE)
        pose_files = {pair.stamp: folder / f"{pair.colour.split('.')[0]}.pose.txt" for pair in pairs}
        self._info = info = find_sensor_info(folder)
        super().__init__(
            folder,
            pairs,
            camera,
            lambda: read_poses({stamp: path for stamp, path in pose_files.items() if path.is_file()}),
            published=lambda: CAMERA if info is None else first_readable(partial(_depth_camera, folder, info), pairs),
            name="/".join(folder.resolve().parts[-2:]),
            pairing_note=note,
        )
        is_built_in = camera is None and camera_file(folder) is None and info is None
        if is_built_in and not _is_original(folder, pairs[0]):
            self.camera_note = (
                "the camera is that of 7-Scenes, with a focal length of 585 pixels; for a recording of another data"
                " set, add its info.txt or a camera.yaml to the folder"
            )

    @staticmethod
    def _image_size(folder: Path, pair: ImagePair) -> tuple[int, int]:
        return image_size(folder / pair.depth)

    def _read_colour(self, index: int) -> Tensor:
        """Read a colour image, and warp it to the depth camera if both cameras are known."""
        colour = super()._read_colour(index)
        info = self._info
        colour_size, size = (colour.shape[2], colour.shape[1]), (self.camera.width, self.camera.height)
        if info is None or (colour_size == size and np.allclose(info.K_colour, info.K_depth)):
            return colour
        check_principal_point(info.K_colour[0, 2], info.K_colour[1, 2], colour_size, info.path)
        return warp_colour(colour, info.K_colour, self.camera.K.numpy(), size)


def is_seven_scenes(path: Path) -> bool:
    """Check whether a folder contains frames with the names of the dataset."""
    return any(path.glob("frame-*.color.*")) and any(path.glob("frame-*.depth.*"))


def _is_original(folder: Path, pair: ImagePair) -> bool:
    """Check for a sequence of 7-Scenes itself, by its folder ``seq-01`` and its colour images, which are PNG."""
    return re.fullmatch(r"seq-\d+", folder.resolve().name) is not None and pair.colour.endswith(".png")


def _depth_camera(folder: Path, info: SensorInfo, pair: ImagePair) -> PinholeCamera:
    """Camera of the depth images according to ``info.txt``."""
    size = image_size(folder / pair.depth)
    check_principal_point(info.K_depth[0, 2], info.K_depth[1, 2], size, info.path)
    return camera_from_matrix(info.K_depth, size, info.depth_scale, info.path)
