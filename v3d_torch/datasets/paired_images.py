"""Sequences with one colour file and one depth file per frame."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from v3d_torch.datasets.images import read_colour, read_depth
from v3d_torch.datasets.lists import ImagePair
from v3d_torch.datasets.stored import ReadGroundTruth, StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera


class PairedImages(StoredSequence):
    """Sequence of paired colour and depth image files.

    Args:
        folder: Folder of the sequence.
        pairs: Image files of the frames, in temporal order.
        camera: Camera of all frames.
        groundtruth: Function that reads the measured poses of the camera.
        name: Name used in tables; None for the folder's name.

    Raises:
        InputError: If an image file is missing.
    """

    def __init__(
        self,
        folder: Path,
        pairs: list[ImagePair],
        camera: PinholeCamera,
        groundtruth: ReadGroundTruth | None = None,
        *,
        name: str | None = None,
    ) -> None:
        missing = [file for pair in pairs for file in (pair.colour, pair.depth) if not (folder / file).is_file()]
        if missing:
            raise InputError(
                f"{folder / missing[0]}: is listed but does not exist ({len(missing)} missing in total);"
                " copy the whole sequence again"
            )
        stamps, delays = [pair.stamp for pair in pairs], [pair.depth_delay for pair in pairs]
        super().__init__(name or folder.resolve().name, stamps, camera, groundtruth, delays)
        self.folder = folder
        self._pairs = pairs

    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        colour, depth = (self.folder / file for file in (self._pairs[index].colour, self._pairs[index].depth))
        return self._check_registered(
            (colour, self._read_colour(colour)), (depth, read_depth(depth, self.camera.depth_scale))
        )

    def _read_colour(self, path: Path) -> Tensor:
        """Read the colour image of a frame; a subclass can also warp the image to the depth camera."""
        return read_colour(path)
