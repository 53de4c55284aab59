"""Sequences with one colour file and one depth file per frame."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from v3d_torch.datasets.images import read_colour, read_depth
from v3d_torch.datasets.lists import ImagePair
from v3d_torch.datasets.stored import ReadGroundTruth, StoredSequence
from v3d_torch.geometry.camera import PinholeCamera


class PairedImages(StoredSequence):
    """Sequence of paired colour and depth image files.

    Args:
        folder: Folder of the sequence.
        pairs: Image files of the frames, in temporal order.
        camera: Camera of all frames.
        groundtruth: Function that reads the measured poses of the camera.
        name: Name used in tables; None for the folder's name.
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
        stamps, delays = [pair.stamp for pair in pairs], [pair.depth_delay for pair in pairs]
        super().__init__(name or folder.resolve().name, stamps, camera, groundtruth, delays)
        self.folder = folder
        self._pairs = pairs

    def files(self, index: int) -> tuple[Path, Path]:
        """Return the colour and the depth file of frame ``index``."""
        return self.folder / self._pairs[index].colour, self.folder / self._pairs[index].depth

    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        colour, depth = self.files(index)
        return self._check_registered(
            (colour, self._read_colour(colour)), (depth, read_depth(depth, self.camera.depth_scale))
        )

    def _read_colour(self, path: Path) -> Tensor:
        """Read the colour image of a frame; a subclass can also warp the image to the depth camera."""
        return read_colour(path)
