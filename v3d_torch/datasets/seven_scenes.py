"""Microsoft 7-Scenes (Shotton et al., CVPR 2013), and other datasets with the same layout."""

from __future__ import annotations

from pathlib import Path

from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.image_files import pair_by_number
from v3d_torch.datasets.matrix_files import read_poses
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, depth_scale=1000.0)
"""Published camera of the depth images. The colour images are not registered to them: there is an offset of a few
centimetres between the two sensors."""

_RATE = 30.0
"""Frame rate, Hz. File names contain frame numbers instead of timestamps."""


class SevenScenesSequence(PairedImages):
    """Sequence such as ``chess/seq-01``: ``frame-000000.color.png``, ``.depth.png``, ``.pose.txt``.

    Args:
        folder: Folder of the sequence.
        camera: Camera chosen by the user; None for the camera file in the folder, or else `CAMERA`.

    Raises:
        InputError: If a file is missing or invalid.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        pairs, note = pair_by_number(folder, folder.glob("frame-*.color.*"), folder.glob("frame-*.depth.*"), _RATE)
        pose_files = {pair.stamp: folder / f"{pair.colour.split('.')[0]}.pose.txt" for pair in pairs}
        super().__init__(
            folder,
            pairs,
            camera,
            lambda: read_poses({stamp: path for stamp, path in pose_files.items() if path.is_file()}),
            published=lambda: CAMERA,
            name="/".join(folder.resolve().parts[-2:]),
            pairing_note=note,
        )


def is_seven_scenes(path: Path) -> bool:
    """Check whether a folder contains frames with the names of the dataset."""
    return any(path.glob("frame-*.color.*")) and any(path.glob("frame-*.depth.*"))
