"""Frames that are kept somewhere and can be read in any order: what all such sequences have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.errors import InputError
from v3d_torch.types import RGBDFrame, Trajectory


class StoredFrames(ABC):
    """An `RGBDSequence` of which a subclass says how a frame's images are read.

    Args:
        name: for tables.
        stamps: of the colour images, seconds, strictly increasing.
        camera: that took all frames.
        groundtruth: measured poses of that camera, where there are some.
    """

    def __init__(
        self, name: str, stamps: Sequence[float], camera: PinholeCamera, groundtruth: Trajectory | None = None
    ) -> None:
        self.name = name
        self.stamps: Tensor = torch.tensor(stamps, dtype=torch.float64)
        self.camera = camera
        self.groundtruth = groundtruth

    def __len__(self) -> int:
        return self.stamps.shape[0]

    def __iter__(self) -> Iterator[RGBDFrame]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> RGBDFrame:
        """Decode frame ``index``, from 0.

        Raises:
            IndexError: there is no such frame.
            InputError: an image is broken, of the wrong kind or not of the camera's size.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has {len(self)} frames, there is none with index {index}")
        image, depth = self._read(index)
        return RGBDFrame(index=index, stamp=float(self.stamps[index]), image=image, depth=depth, camera=self.camera)

    @abstractmethod
    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        """Colour and depth of a frame that there is, as `RGBDFrame` holds them."""

    def _sized(self, source: object, image: Tensor) -> Tensor:
        """The image (C, H, W), which came from ``source``, if it has the camera's size."""
        height, width = image.shape[1:]
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"{source}: has {width}x{height} pixels, the camera {self.camera.width}x{self.camera.height};"
                " give the camera that took it with --camera"
            )
        return image
