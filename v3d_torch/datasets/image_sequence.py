"""Stored sequences whose colour and depth images are read from files or messages, depth in its own unit."""

from __future__ import annotations

from abc import abstractmethod
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.broken_frames import max_broken_frames
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.depth_scale import estimate_depth_scale
from v3d_torch.geometry.depth_units import depth_to_metres, implausible_median

_SAMPLES = 8
"""Number of frames from which an unknown depth scale is estimated."""


class ImageSequence(StoredSequence):
    """Base class of sequences that read the colour and depth image of a frame separately.

    A subclass whose depth scale can be unknown calls `_settle_depth_scale` at the end of its constructor.

    Args:
        name, stamps, camera, groundtruth, delays: As for `StoredSequence`.
    """

    depth_scale_note: str | None = None
    """Sentence that reports how the depth scale was estimated; None if it is stated."""

    camera_note: str | None = None
    """Sentence that reports a camera that may be another one; None if it is certain."""

    pairing_note: str | None = None
    """Sentence on the pairing of colour and depth images, such as on images that are left out; None if there is nothing
    to report."""

    registration_fix = "export depth that is registered to the colour image"
    """Fix for colour and depth of different sizes, for messages."""

    @property
    def notes(self) -> list[str]:
        """Sentences about the sequence that a user needs to know, such as how the depth scale was estimated."""
        notes = (self.camera_note, self.depth_scale_note, self.pairing_note)
        return [*super().notes, *(note for note in notes if note is not None)]

    def check(self, source: object, *, skip_broken: bool = False) -> None:
        """Check that all files exist, and decode the first frame, so that errors are reported before a long run.

        Args:
            source: Path of the sequence, for messages.
            skip_broken: True to allow missing files, and broken frames at the start.

        Raises:
            InputError: If a file is missing, the frame cannot be decoded, or its median depth is implausible.
        """
        missing = [file for index in range(len(self)) for file in self.files(index) if not file.is_file()]
        if missing and not skip_broken:
            raise InputError(
                f"{missing[0]}: is listed but does not exist ({len(missing)} missing in total);"
                f" {_explain_missing(missing[0])}"
            )
        first, depth = self._read_first(max_broken_frames(len(self)) if skip_broken else 0)
        median = implausible_median(depth)
        if median is None:
            return
        found = f"{source}: the median depth of the first frame is {median:.2g} m"
        if self._read_depth(first).dtype.kind == "f" or self.camera.depth_scale is None:
            raise InputError(f"{found}, although depth in floating point is in metres; export it in metres")
        raise InputError(
            f"{found} at {self.camera.depth_scale:g} units per metre; correct the camera's depth_scale (1000 if depth"
            " is in millimetres) or the depth images"
        )

    def _read_first(self, broken: int) -> tuple[int, Tensor]:
        """Return index and depth of the first frame that can be read, after at most this number of broken frames.

        Raises:
            InputError: If more frames are broken; the error is that of the last frame that was tried.
        """
        last = min(broken, len(self) - 1)
        for index in range(last):
            with suppress(InputError):
                return index, self._read(index)[1]
        return last, self._read(last)[1]

    @abstractmethod
    def _sources(self, index: int) -> tuple[object, object]:
        """Return the origins of the colour and depth image of a frame, for messages."""

    @abstractmethod
    def _read_colour(self, index: int) -> Tensor:
        """Read the colour image of an existing frame, in the format of `RGBDFrame`."""

    @abstractmethod
    def _read_depth(self, index: int) -> NDArray[np.generic]:
        """Read the depth image of an existing frame: whole numbers in units, or metres in floating point, (H, W)."""

    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        """Read the colour and depth image of an existing frame, in the format of `RGBDFrame`."""
        colour_source, depth_source = self._sources(index)
        image = self._read_colour(index)
        depth = depth_to_metres(self._read_depth(index), self.camera.depth_scale)
        depth_size, colour_size = (f"{each.shape[2]}x{each.shape[1]}" for each in (depth, image))
        if depth_size != colour_size:
            raise InputError(
                f"{depth_source}: has {depth_size} pixels, but its colour image has {colour_size};"
                f" {self.registration_fix}"
            )
        return self._check_size(colour_source, image), depth

    def _check_size(self, source: object, image: Tensor) -> Tensor:
        """Return the image (C, H, W) read from ``source`` if it has the camera's size."""
        height, width = image.shape[1:]
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"{source}: has {width}x{height} pixels, but the camera has {self.camera.width}x{self.camera.height};"
                " pass the camera of these images with --camera"
            )
        return image

    def _settle_depth_scale(self, source: object, limit: int | None = None) -> None:
        """Estimate the depth scale if the camera does not state it and depth has whole numbers.

        Args:
            source: Path of the sequence, for messages.
            limit: Number of frames at the beginning from which images are sampled; None for all frames.

        Raises:
            InputError: If no depth image can be read, or the depth scale cannot be estimated from the images.
        """
        if self.camera.depth_scale is not None:
            return
        images = []
        last = len(self) - 1 if limit is None else min(len(self), limit) - 1
        for index in dict.fromkeys(np.linspace(0, last, _SAMPLES).astype(int).tolist()):
            with suppress(InputError):  # reported when the frame is processed
                images.append(self._read_depth(index))
        images = images or [self._read_depth(0)]
        if images[0].dtype.kind == "f":
            return
        estimate = estimate_depth_scale(images)
        if estimate.depth_scale is None:
            raise InputError(f"{source}: {estimate.file_prompt}")
        self.camera = replace(self.camera, depth_scale=estimate.depth_scale)
        self.depth_scale_note = estimate.note


def _explain_missing(file: Path) -> str:
    """Return the fix for a listed file that does not exist, for messages."""
    if any(PureWindowsPath(part).drive for part in file.absolute().parts[1:]):  # the first is that of this machine
        return "the list has Windows paths; write them relative to its folder, such as rgb/1.png"
    return "copy the whole sequence again"
