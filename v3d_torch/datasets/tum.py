"""A folder in the layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.datasets.cameras import find_camera, load_camera
from v3d_torch.datasets.images import read_colour, read_depth
from v3d_torch.datasets.lists import MAX_DIFFERENCE, Pair, pair_images, read_associations, read_image_list
from v3d_torch.datasets.names import short_name
from v3d_torch.errors import InputError
from v3d_torch.trajectory import read_trajectory
from v3d_torch.types import RGBDFrame, Trajectory


class TUMSequence:
    """Frames of a folder with ``associations.txt``, or ``rgb.txt`` and ``depth.txt``.

    Args:
        folder: the sequence's folder; a ``groundtruth.txt`` in it is read, too.
        camera: a camera, a preset's name or a camera file; None takes what the folder says (see `find_camera`).
        name: for tables; None makes it from the folder's name.

    Raises:
        InputError: the folder or one of its files is missing or wrong; the message names it and the cure.
    """

    def __init__(
        self, folder: Path, camera: str | Path | PinholeCamera | None = None, *, name: str | None = None
    ) -> None:
        if not folder.is_dir():
            what = "is a file" if folder.exists() else "is not there"
            raise InputError(f"{folder}: {what}; a sequence is a folder with rgb.txt and depth.txt")
        self.folder = folder
        self.name = short_name(folder.resolve().name) if name is None else name
        self._pairs = _read_pairs(folder)
        self.stamps: Tensor = torch.tensor([pair.stamp for pair in self._pairs], dtype=torch.float64)
        self.camera: PinholeCamera = _choose_camera(folder, camera)
        groundtruth = folder / "groundtruth.txt"
        self.groundtruth: Trajectory | None = read_trajectory(groundtruth) if groundtruth.is_file() else None

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> RGBDFrame:
        """Decode frame ``index``, from 0.

        Raises:
            IndexError: there is no such frame.
            InputError: an image is broken, of the wrong kind or not of the camera's size.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has {len(self)} frames, there is none with index {index}")
        pair = self._pairs[index]
        image = self._sized(self.folder / pair.colour, read_colour(self.folder / pair.colour))
        depth_path = self.folder / pair.depth
        depth = self._sized(depth_path, read_depth(depth_path, self.camera.depth_scale))
        return RGBDFrame(index=index, stamp=pair.stamp, image=image, depth=depth)

    def _sized(self, path: Path, image: Tensor) -> Tensor:
        height, width = image.shape[1:]
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"{path}: has {width}x{height} pixels, the camera {self.camera.width}x{self.camera.height};"
                " give the camera that took it with --camera"
            )
        return image


def _choose_camera(folder: Path, camera: str | Path | PinholeCamera | None) -> PinholeCamera:
    if isinstance(camera, PinholeCamera):
        return camera
    return find_camera(folder) if camera is None else load_camera(camera)


def _read_pairs(folder: Path) -> list[Pair]:
    """Colour and depth files in order of time, all of them there."""
    if (folder / "associations.txt").is_file():
        pairs = read_associations(folder / "associations.txt")
    else:
        for name in ("rgb.txt", "depth.txt"):
            if not (folder / name).is_file():
                raise InputError(
                    f"{folder}: has no {name}; a sequence holds rgb.txt and depth.txt, or associations.txt"
                )
        pairs = pair_images(read_image_list(folder / "rgb.txt"), read_image_list(folder / "depth.txt"))
        if not pairs:
            raise InputError(
                f"{folder}: no stamp in rgb.txt lies within {MAX_DIFFERENCE} s of one in depth.txt;"
                " do both lists belong to this sequence?"
            )
    missing = [name for pair in pairs for name in (pair.colour, pair.depth) if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"{folder / missing[0]}: is listed but not there ({len(missing)} such files); copy the whole sequence again"
        )
    return pairs
