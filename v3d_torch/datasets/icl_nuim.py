"""ICL-NUIM (Handa et al., ICRA 2014): its "TUM RGB-D compatible" version, and its original files from POV-Ray."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.image_files import pair_by_number
from v3d_torch.datasets.lists import ImagePair, read_associations
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.datasets.tum_trajectory import read_groundtruth
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.text_file import read_text
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(481.2, 480.0, 319.5, 239.5, depth_scale=5000.0, readout=0.0)
"""Published camera of the dataset, except for the sign of fy: the y axis of the ray tracer points up (fy = -480), that
of the images points down. All rows of a rendered image are simultaneous, so the readout is 0."""

_RATE = 30.0
"""Frame rate, Hz. The lists contain frame numbers instead of timestamps."""

_FLIP_Y = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))


class ICLNUIMSequence(PairedImages):
    """Sequence of ICL-NUIM with ground truth in ``*.gt.freiburg``, in one of two layouts.

    The TUM-compatible version, such as ``living_room_traj0_frei_png``, has ``associations.txt`` and depth along z as
    16-bit PNG. The original files, such as ``living_room_traj0_loop``, are ``scene_00_0000.png`` and
    ``scene_00_0000.depth``: a text with the distance along the ray of each pixel, metres. It is converted to depth.

    Args:
        folder: Folder of the sequence.
        camera: Camera chosen by the user; None for the camera file in the folder, or else `CAMERA`.

    Raises:
        InputError: If a file is missing or invalid.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        self._is_original = _is_original(folder)
        groundtruth_files = sorted(folder.glob("*.gt.freiburg*"))
        if len(groundtruth_files) > 1:
            raise InputError(
                f"{folder}: has several ground-truth files ({', '.join(path.name for path in groundtruth_files)});"
                " keep only the file of this sequence"
            )
        pairs, note = _original_pairs(folder) if self._is_original else (_listed_pairs(folder), None)
        super().__init__(
            folder,
            pairs,
            camera,
            lambda: read_groundtruth(groundtruth_files[0]).convert(camera_poses) if groundtruth_files else None,
            published=lambda: CAMERA,
            pairing_note=note,
        )

    def _read_depth(self, index: int) -> NDArray[np.generic]:
        if not self._is_original:
            return super()._read_depth(index)
        path = self._sources(index)[1]
        width, height = self.camera.width, self.camera.height
        distances = _read_numbers(path)
        if distances.size != width * height:
            raise InputError(
                f"{path}: has {distances.size} numbers, expected {width}x{height}, one for each pixel; copy it again"
            )
        return distances.reshape(height, width) / self.camera.rays.norm(dim=-1).numpy()


def is_icl_nuim(path: Path) -> bool:
    """Check whether a folder contains the files of an ICL-NUIM sequence."""
    return _is_original(path) or ((path / "associations.txt").is_file() and any(path.glob("*.gt.freiburg*")))


def camera_poses(published: Trajectory) -> Trajectory:
    """Convert published poses to this package's convention.

    Frame numbers become timestamps. The y axes of camera and world point up in the published poses, and down in the
    result.
    """
    return Trajectory(published.stamps / _RATE, _FLIP_Y @ published.T_wc @ _FLIP_Y)


def _is_original(folder: Path) -> bool:
    return any(folder.glob("scene_*.depth"))


def _original_pairs(folder: Path) -> tuple[list[ImagePair], str | None]:
    """Pairs of the original files, see `pair_by_number`; frame n has the number n in its file names and the truth."""
    return pair_by_number(folder, folder.glob("scene_*.png"), folder.glob("scene_*.depth"), _RATE)


def _listed_pairs(folder: Path) -> list[ImagePair]:
    return [
        ImagePair(pair.stamp / _RATE, pair.colour, pair.depth)
        for pair in read_associations(folder / "associations.txt")[0]  # a note would give frames as seconds
    ]


def _read_numbers(path: Path) -> NDArray[np.float64]:
    """Read a text of numbers."""
    try:
        return np.array(read_text(path, "it contains a distance for each pixel").split(), dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: contains a value that is not a number ({error}); copy it again") from error
