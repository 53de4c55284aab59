"""ETH3D SLAM benchmark (Schöps et al., CVPR 2019): TUM layout with the camera in a file of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from v3d_torch.datasets.broken_frames import first_readable
from v3d_torch.datasets.cameras import CameraChoice, load_camera
from v3d_torch.datasets.image_files import list_images
from v3d_torch.datasets.images import image_size
from v3d_torch.datasets.locate import is_tum
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.numbers import parse_number
from v3d_torch.io.text_file import read_text

_DEPTH_SCALE = 5000.0
"""Depth units per metre."""

_CAMERA_FILE = "calibration.txt"
"""File with ``fx fy cx cy``; the images have no lens distortion."""


class ETH3DSequence(TUMSequence):
    """Sequence of the ETH3D SLAM benchmark, such as ``cables_1``, with the RGB-D part of its files.

    All cameras of the rig have a global shutter and are synchronised, so the readout is 0.

    Args:
        folder: Folder of the sequence.
        camera: Camera chosen by the user; None for the ``camera.yaml`` or ``K.txt`` in the folder, or else
            ``calibration.txt``.

    Raises:
        InputError: If the folder or one of its files is missing or invalid.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        super().__init__(folder, camera, published=lambda: _published_camera(folder))


def is_eth3d(path: Path) -> bool:
    """Check whether a folder contains the lists of the TUM layout, and four numbers in the camera file."""
    return is_tum(path) and (path / _CAMERA_FILE).is_file() and _has_four_numbers(path / _CAMERA_FILE)


def _has_four_numbers(path: Path) -> bool:
    """Check the content of a file; other recordings can have files of this name."""
    try:
        numbers = [parse_number(word) for word in read_text(path, "it contains fx fy cx cy").split()]
    except (InputError, ValueError):
        return False
    return len(numbers) == 4


def _published_camera(folder: Path) -> PinholeCamera:
    camera = load_camera(folder / _CAMERA_FILE, lambda: first_readable(image_size, list_images(folder / "rgb")))
    return replace(camera, depth_scale=_DEPTH_SCALE, readout=0.0)
