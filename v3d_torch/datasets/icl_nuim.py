"""ICL-NUIM (Handa et al., ICRA 2014), the version with PNG images that it calls TUM RGB-D compatible."""

from __future__ import annotations

from pathlib import Path

import torch

from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.lists import ImagePair, read_associations
from v3d_torch.datasets.paired import PairedImages
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(481.2, 480.0, 319.5, 239.5, readout=0.0)
"""As published, but fy, which is -480 there because the ray tracer's y axis points up: the images have theirs down.
Rendered images have all rows of one time."""

_RATE = 30.0
"""Frames a second: the lists number the frames."""

_FLIP_Y = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))


class ICLNUIMSequence(PairedImages):
    """Frames of a folder such as ``living_room_traj0_frei_png``: ``associations.txt`` and ``*.gt.freiburg``.

    Args:
        folder: the sequence's folder.
        camera: the user's choice; None takes `CAMERA`, unless the folder holds a camera of its own.

    Raises:
        InputError: a file is missing or wrong.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        pairs = [
            ImagePair(pair.stamp / _RATE, pair.colour, pair.depth)
            for pair in read_associations(folder / "associations.txt")
        ]
        truths = sorted(folder.glob("*.gt.freiburg*"))
        if len(truths) > 1:
            raise InputError(
                f"{folder}: has several ground truths ({', '.join(path.name for path in truths)}); leave only the"
                " sequence's own there"
            )
        super().__init__(
            folder, pairs, choose_camera(camera, folder, CAMERA), lambda: camera_poses(read_trajectory(truths[0]))
        )


def is_icl_nuim(path: Path) -> bool:
    """Whether a folder holds what the dataset's do."""
    return (path / "associations.txt").is_file() and any(path.glob("*.gt.freiburg*"))


def camera_poses(published: Trajectory) -> Trajectory:
    """Poses by frame number, y up in camera and world, to poses by time, y down in both."""
    return Trajectory(published.stamps / _RATE, _FLIP_Y @ published.T_wc @ _FLIP_Y)
