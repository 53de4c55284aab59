"""Microsoft 7-Scenes (Shotton et al., CVPR 2013) and what is stored alike."""

from __future__ import annotations

from pathlib import Path

from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.file_names import numbered_pairs
from v3d_torch.datasets.matrices import read_poses
from v3d_torch.datasets.paired import PairedImages
from v3d_torch.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, depth_scale=1000.0)
"""Of the depth, as published. Its colour was never registered to it: pixels are a few centimetres' worth apart."""

_RATE = 30.0
"""Frames a second: the names number the frames."""


class SevenScenesSequence(PairedImages):
    """Frames of a folder such as ``chess/seq-01``: ``frame-000000.color.png``, ``.depth.png``, ``.pose.txt``.

    Args:
        folder: the sequence's folder.
        camera: the user's choice; None takes `CAMERA`, unless the folder holds a camera of its own.

    Raises:
        InputError: a file is missing or wrong.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        pairs = numbered_pairs(folder, folder.glob("frame-*.color.*"), folder.glob("frame-*.depth.*"), _RATE)
        poses = {pair.stamp: folder / f"{pair.colour.split('.')[0]}.pose.txt" for pair in pairs}
        super().__init__(
            folder,
            pairs,
            choose_camera(camera, folder, CAMERA),
            lambda: read_poses({stamp: path for stamp, path in poses.items() if path.is_file()}),
            name="/".join(folder.resolve().parts[-2:]),
        )


def is_seven_scenes(path: Path) -> bool:
    """Whether a folder holds frames named as the dataset's are."""
    return any(path.glob("frame-*.color.*")) and any(path.glob("frame-*.depth.*"))
