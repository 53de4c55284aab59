"""Sequences whose every frame is a colour file and a depth file."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from v3d_torch.datasets.images import read_colour, read_depth
from v3d_torch.datasets.lists import ImagePair
from v3d_torch.datasets.stored import ReadTruth, StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera


class PairedImages(StoredSequence):
    """Frames of a folder of images.

    Args:
        folder: the sequence's folder.
        pairs: the frames' files, in order of time.
        camera: that took them.
        groundtruth: see `StoredSequence`.
        name: for tables; None takes the folder's name.

    Raises:
        InputError: a file is missing.
    """

    def __init__(
        self,
        folder: Path,
        pairs: list[ImagePair],
        camera: PinholeCamera,
        groundtruth: ReadTruth | None = None,
        *,
        name: str | None = None,
    ) -> None:
        missing = [file for pair in pairs for file in (pair.colour, pair.depth) if not (folder / file).is_file()]
        if missing:
            raise InputError(
                f"{folder / missing[0]}: is listed but not there ({len(missing)} such files);"
                " copy the whole sequence again"
            )
        stamps, delays = [pair.stamp for pair in pairs], [pair.depth_delay for pair in pairs]
        super().__init__(name or folder.resolve().name, stamps, camera, groundtruth, delays)
        self.folder = folder
        self._pairs = pairs

    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        colour, depth = (self.folder / file for file in (self._pairs[index].colour, self._pairs[index].depth))
        return self._registered((colour, self._colour(colour)), (depth, read_depth(depth, self.camera.depth_scale)))

    def _colour(self, path: Path) -> Tensor:
        return read_colour(path)
