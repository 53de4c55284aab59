"""ICL-NUIM (Handa et al., ICRA 2014), in its "TUM RGB-D compatible" version with PNG images."""

from __future__ import annotations

from pathlib import Path

import torch

from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.lists import ImagePair, read_associations
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(481.2, 480.0, 319.5, 239.5, readout=0.0)
"""Published camera of the dataset, except for the sign of fy: the ray tracer's y axis points up (fy = -480), the y axis
of the images points down. All rows of a rendered image have the same time, so the readout is 0."""

_RATE = 30.0
"""Frame rate, Hz. The lists contain frame numbers instead of timestamps."""

_FLIP_Y = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))


class ICLNUIMSequence(PairedImages):
    """Sequence of ICL-NUIM, such as ``living_room_traj0_frei_png``: ``associations.txt`` and ``*.gt.freiburg``.

    Args:
        folder: Folder of the sequence.
        camera: Camera chosen by the user; None for the camera file in the folder, or else `CAMERA`.

    Raises:
        InputError: If a file is missing or invalid.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        pairs = [
            ImagePair(pair.stamp / _RATE, pair.colour, pair.depth)
            for pair in read_associations(folder / "associations.txt")
        ]
        groundtruth_files = sorted(folder.glob("*.gt.freiburg*"))
        if len(groundtruth_files) > 1:
            raise InputError(
                f"{folder}: has several ground-truth files ({', '.join(path.name for path in groundtruth_files)});"
                " keep only the file of this sequence"
            )
        super().__init__(
            folder,
            pairs,
            choose_camera(camera, folder, CAMERA),
            lambda: camera_poses(read_trajectory(groundtruth_files[0])),
        )


def is_icl_nuim(path: Path) -> bool:
    """Check whether a folder contains the files of an ICL-NUIM sequence."""
    return (path / "associations.txt").is_file() and any(path.glob("*.gt.freiburg*"))


def camera_poses(published: Trajectory) -> Trajectory:
    """Convert published poses to this package's convention.

    Frame numbers become timestamps. The y axes of camera and world point up in the published poses, and down in the
    result.
    """
    return Trajectory(published.stamps / _RATE, _FLIP_Y @ published.T_wc @ _FLIP_Y)
