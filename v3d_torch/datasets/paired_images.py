"""Sequences with one colour file and one depth file per frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.broken_frames import first_readable
from v3d_torch.datasets.cameras import CameraChoice, PublishedCamera, choose_camera
from v3d_torch.datasets.depth_files import read_depth_file
from v3d_torch.datasets.groundtruth import ReadGroundTruth
from v3d_torch.datasets.image_sequence import ImageSequence
from v3d_torch.datasets.images import image_size, read_colour
from v3d_torch.datasets.lists import ImagePair


class PairedImages(ImageSequence):
    """Sequence of paired colour and depth image files.

    Args:
        folder: Folder of the sequence.
        pairs: Image files of the frames, in temporal order.
        camera: Camera chosen by the user; None for the camera of the folder or the layout (`choose_camera`).
        groundtruth: Function that reads the measured poses of the camera.
        published: Function that gives the camera that the layout states (`choose_camera`); None if it states none.
        depth_scale: Depth units per metre that the layout prescribes; None if it does not prescribe them.
        name: Name used in tables; None for the folder's name.
        pairing_note: Sentence on the pairing of the images; None if there is nothing to report.

    Raises:
        InputError: If there is no camera, or the unit of depth is not stated and cannot be estimated from the images.
    """

    def __init__(
        self,
        folder: Path,
        pairs: list[ImagePair],
        camera: CameraChoice,
        groundtruth: ReadGroundTruth | None = None,
        *,
        published: PublishedCamera | None = None,
        depth_scale: float | None = None,
        name: str | None = None,
        pairing_note: str | None = None,
    ) -> None:
        chosen = choose_camera(
            camera,
            folder,
            published,
            depth_scale=depth_scale,
            image_size=lambda: first_readable(lambda pair: self._image_size(folder, pair), pairs),
        )
        stamps, delays = [pair.stamp for pair in pairs], [pair.depth_delay for pair in pairs]
        super().__init__(name or folder.resolve().name, stamps, chosen, groundtruth, delays)
        self.folder = folder
        self._pairs = pairs
        self.pairing_note = pairing_note
        self._settle_depth_scale(folder)

    @staticmethod
    def _image_size(folder: Path, pair: ImagePair) -> tuple[int, int]:
        """Width and height of the images of the camera, given the files of a frame."""
        return image_size(folder / pair.colour)

    def files(self, index: int) -> tuple[Path, Path]:
        """Return the colour and the depth file of frame ``index``."""
        return self.folder / self._pairs[index].colour, self.folder / self._pairs[index].depth

    def _sources(self, index: int) -> tuple[Path, Path]:
        return self.files(index)

    def _read_colour(self, index: int) -> Tensor:
        return read_colour(self.files(index)[0])

    def _read_depth(self, index: int) -> NDArray[np.generic]:
        return read_depth_file(self.files(index)[1])
