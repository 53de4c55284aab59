"""Frames that are kept somewhere and can be read in any order: what all such sequences have in common."""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame, Trajectory

ReadTruth = Callable[[], Trajectory | None]
"""Reads the ground truth; None where there is none."""

_DEPTHS = (0.05, 50.0)
"""Metres between which an RGB-D camera measures, with room to spare."""


class StoredSequence(ABC):
    """An `RGBDSequence` of which a subclass says how a frame's images are read.

    Args:
        name: for tables.
        stamps: of the colour images, seconds, strictly increasing.
        camera: that took all frames.
        groundtruth: reads the measured poses of that camera.
        delays: of the depth images, seconds after the colour images; None where both were taken at once.

    Attributes:
        groundtruth: these poses; None where there are none, or they cannot be read, as the frames still can.
        groundtruth_error: why they cannot be read.
    """

    def __init__(
        self,
        name: str,
        stamps: Sequence[float],
        camera: PinholeCamera,
        groundtruth: ReadTruth | None = None,
        delays: Sequence[float] | None = None,
    ) -> None:
        self.name = name.encode(errors="replace").decode()  # a folder's name need not be text
        self.stamps: Tensor = torch.tensor(stamps, dtype=torch.float64)
        self.camera = camera
        self._delays = delays or [0.0] * len(stamps)
        self.groundtruth: Trajectory | None = None
        self.groundtruth_error: InputError | None = None
        try:
            self.groundtruth = groundtruth() if groundtruth is not None else None
        except InputError as error:
            self.groundtruth_error = error

    def __len__(self) -> int:
        return self.stamps.shape[0]

    def __iter__(self) -> Iterator[RGBDFrame]:
        return self.frames_from(0)

    def frames_from(self, index: int) -> Iterator[RGBDFrame]:
        """The frames from one on, read as they are asked for."""
        return FrameIterator(self, index)

    def __getitem__(self, index: int) -> RGBDFrame:
        """Decode frame ``index``, from 0.

        Raises:
            IndexError: there is no such frame.
            InputError: an image is broken, of the wrong kind or not of the camera's size, or ``index`` is no number.
        """
        try:
            index = operator.index(index)
        except TypeError as error:
            raise InputError(
                f"{self.name}: frames are read one by one, by their numbers, and not by {index!r}; take several with"
                " itertools.islice(sequence, start, stop)"
            ) from error
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has {len(self)} frames, there is none with index {index}")
        image, depth = self._read(index)
        stamp = float(self.stamps[index])
        return RGBDFrame(index, stamp, image, depth, camera=self.camera, depth_delay=self._delays[index])

    def check_first_frame(self, source: object) -> None:
        """Decode the first frame, so that what is wrong with every frame is said before anything else is done.

        Args:
            source: of the frames, for messages.

        Raises:
            InputError: as `__getitem__`, or its depth is none that such a camera measures.
        """
        depth = self._read(0)[1]
        middle = float(depth[depth > 0].median()) if bool((depth > 0).any()) else 1.0
        if not _DEPTHS[0] < middle < _DEPTHS[1]:
            scale = f"{self.camera.depth_scale:g} units per metre"
            raise InputError(
                f"{source}: the depth of its first frame is {middle:.2g} m in the middle, at {scale}; correct the"
                " camera's depth_scale (1000 where depth is in millimetres), or the images"
            )

    @abstractmethod
    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        """Colour and depth of a frame that there is, as `RGBDFrame` holds them."""

    def _registered(
        self,
        colour: tuple[object, Tensor],
        depth: tuple[object, Tensor],
        cure: str = "export the depth that is registered to colour, pixel by pixel",
    ) -> tuple[Tensor, Tensor]:
        """Colour and depth images (C, H, W), each with where it came from, if they have one size, the camera's."""
        sizes = [f"{image.shape[2]}x{image.shape[1]}" for _, image in (depth, colour)]
        if sizes[0] != sizes[1]:
            raise InputError(f"{depth[0]}: has {sizes[0]} pixels, its colour image {sizes[1]}; {cure}")
        return self._sized(*colour), depth[1]

    def _sized(self, source: object, image: Tensor) -> Tensor:
        """The image (C, H, W), which came from ``source``, if it has the camera's size."""
        height, width = image.shape[1:]
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"{source}: has {width}x{height} pixels, the camera {self.camera.width}x{self.camera.height};"
                " give the camera that took it with --camera"
            )
        return image


class FrameIterator(Iterator[RGBDFrame]):
    """Frames of a stored sequence one after the other.

    Args:
        sequence: of the frames.
        first: index of the first.

    Attributes:
        index: of the next; who has got that frame otherwise may step over it.
    """

    def __init__(self, sequence: StoredSequence, first: int) -> None:
        self.sequence = sequence
        self.index = first

    @property
    def remaining(self) -> int:
        """Frames from the next on."""
        return max(len(self.sequence) - self.index, 0)

    def __next__(self) -> RGBDFrame:
        if not self.remaining:
            raise StopIteration
        frame = self.sequence[self.index]
        self.index += 1
        return frame
