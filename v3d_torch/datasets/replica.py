"""Sequences rendered from Replica (Straub et al., 2019) for iMAP and NICE-SLAM (Zhu et al., CVPR 2022)."""

from __future__ import annotations

import json
from pathlib import Path

from v3d_torch.datasets.camera_fields import camera_from_fields
from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.image_files import pair_by_number
from v3d_torch.datasets.matrix_files import read_pose_lines
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.text_file import read_text

CAMERA = PinholeCamera(600.0, 600.0, 599.5, 339.5, 1200, 680, depth_scale=6553.5, readout=0.0)
"""Published camera of the sequences. All rows of a rendered image are simultaneous, so the readout is 0."""

_RATE = 30.0
"""Frame rate, Hz. File names contain frame numbers instead of timestamps."""

_POSES = "traj.txt"
"""File with the pose of each frame."""

_CAMERA_FILE = "cam_params.json"
"""Camera file of all sequences, in the folder above them; in the folder of a sequence it takes precedence."""

_FIELDS = {"fx": "fx", "fy": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height", "scale": "depth_scale"}
"""Fields of a camera by their names in the camera file."""


class ReplicaSequence(PairedImages):
    """Sequence such as ``room0``: ``results/frame000000.jpg``, ``results/depth000000.png``, and ``traj.txt``.

    Line i of ``traj.txt`` is the camera-to-world pose of frame i, a 4x4 matrix in row-major order.

    Args:
        folder: Folder of the sequence.
        camera: Camera chosen by the user; None for the ``camera.yaml`` or ``K.txt`` in the folder, else
            ``cam_params.json`` in the folder or the one above, else `CAMERA`.

    Raises:
        InputError: If a file is missing or invalid.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        images = folder / "results"
        pairs, note = pair_by_number(folder, images.glob("frame*"), images.glob("depth*"), _RATE)
        super().__init__(
            folder,
            pairs,
            camera,
            lambda: read_pose_lines(folder / _POSES, _RATE),
            published=lambda: _published_camera(folder),
            pairing_note=note,
        )


def is_replica(path: Path) -> bool:
    """Check whether a folder contains poses and frames with the names of the rendered sequences."""
    images = path / "results"
    return (path / _POSES).is_file() and any(images.glob("frame*")) and any(images.glob("depth*"))


def _published_camera(folder: Path) -> PinholeCamera:
    path = next((each / _CAMERA_FILE for each in (folder, folder.parent) if (each / _CAMERA_FILE).is_file()), None)
    if path is None:
        return CAMERA
    try:
        stated = json.loads(read_text(path, "it contains the camera of the sequences"))["camera"]
        fields = {name: stated[key] for key, name in _FIELDS.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: has no camera with {', '.join(_FIELDS)}; copy it again, or pass --camera") from error
    return camera_from_fields({**fields, "readout": 0.0}, str(path))
