"""Instances from a folder of id images."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from v3d_torch.datasets.image_files import list_images, stamp_in_name
from v3d_torch.datasets.images import too_large_error
from v3d_torch.errors import InputError
from v3d_torch.io.image_file import MAX_PIXELS
from v3d_torch.io.paths import StrPath
from v3d_torch.io.safe_yaml import parse_yaml
from v3d_torch.io.text_file import read_text
from v3d_torch.segmentation.coco import COCO_NAMES, PERSON
from v3d_torch.types import Instances, RGBDFrame

_MAX_GAP = 0.02
"""Maximum time between an id image and its frame, seconds: the tolerance of the TUM tools between colour and depth."""

_MAX_GAP_RATIO = 0.49
"""Maximum time between an id image and its frame, in median intervals of the id images: from half an interval on, a
file would also belong to a frame beside its own, whose id image is missing."""

_MAX_INSTANCES = 255
"""Maximum number of instances in an image. A depth image given by mistake has thousands of values, each of which would
become a mask of full size."""


_ADD_ID_IMAGE = "add it, or name the folder that belongs to this sequence"
"""Advice if a frame has no id image."""


class MaskFolder:
    """Instances from id images: single-channel PNG files, 8 or 16 bit, 0 = background, other values = instance ids.

    If all names end in a timestamp such as ``1305031102.175304.png`` (`stamp_in_name`), a file belongs to the nearest
    frame in time, at most 0.02 s and less than half of the interval between id images away. Files with other names
    belong to the frames in the order of their names, in which numbers are compared as numbers: 9.png comes before
    10.png. `check_number` checks that there is one for each frame.

    A file ``labels.yaml`` (or ``labels.yml``) in the folder gives the COCO class of each id, a line ``4: chair`` for
    each; ids that it does not list are no instances. Without this file, all instances are people.

    Args:
        folder: Folder of the id images.

    Attributes:
        folder: Folder of the id images.
        labels: COCO class of each id; None if all instances are people.
        labels_path: Path of the file of the labels, also if there is none.

    Raises:
        InputError: If the folder is missing or contains no PNG file, or ``labels.yaml`` is invalid.
    """

    def __init__(self, folder: StrPath) -> None:
        self.folder = folder = Path(folder)
        self._paths: list[Path] = []
        with suppress(OSError):  # for example a name that is too long
            self._paths = [path for path in list_images(folder) if path.suffix.lower() == ".png"]
        if not self._paths:
            problem = "contains no PNG files" if os.path.lexists(folder) else "does not exist"
            raise InputError(f"{folder}: {problem}; name the folder of the id images with --masks")
        names = "labels.yaml", "labels.yml"
        self.labels_path = next((path for name in names if (path := folder / name).is_file()), folder / names[0])
        self.labels = _read_labels(self.labels_path) if self.labels_path.is_file() else None
        stamps = [stamp for path in self._paths if (stamp := stamp_in_name(path)) is not None]
        self._stamps: Tensor | None = None
        self._max_gap = _MAX_GAP
        if len(stamps) == len(self._paths):
            self._stamps = torch.tensor(stamps, dtype=torch.float64)
            if len(stamps) > 1:
                interval = float(self._stamps.sort().values.diff().median())
                self._max_gap = min(_MAX_GAP, _MAX_GAP_RATIO * interval)

    def check_number(self, frames: int) -> None:
        """Check that files without timestamps in their names can belong to the frames in order.

        A sequence has fewer frames than colour images if images have no partner, so that files made from all colour
        images would belong to the wrong frames.

        Args:
            frames: Number of frames of the sequence.

        Raises:
            InputError: If the number of files is another one.
        """
        if self._stamps is None and len(self._paths) != frames:
            raise InputError(
                f"{self.folder}: has {len(self._paths)} id images for {frames} frames, and their names are not"
                " timestamps; name each one by the timestamp of its frame, or write one for each frame"
            )

    def check_stamps(self, stamps: Tensor) -> None:
        """Check that there is an id image for each frame, before a run that would end at a frame without one.

        Args:
            stamps: Timestamps of the frames of the sequence, seconds, float64, shape :math:`(F,)`.

        Raises:
            InputError: If a frame has no id image.
        """
        missing = [i for i, stamp in enumerate(stamps.tolist()) if self.find_path(i, stamp) is None]
        if missing:
            raise InputError(
                f"{self.folder}: has no id image for {len(missing)} of {len(stamps)} frames, the first of them frame"
                f" {missing[0]} at {float(stamps[missing[0]]):.6f} s; {_ADD_ID_IMAGE}"
            )

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Return the instances of a frame in the order of their ids, each with the score 1.

        Raises:
            InputError: If the frame has no id image, or the image is unreadable, of another size or of several
                channels, or has too many ids.
        """
        return self.read(frame)[0]

    def read(self, frame: RGBDFrame) -> tuple[Instances, Tensor]:
        """Return the instances of a frame and their ids in the file, int64, shape :math:`(N,)`.

        Raises:
            InputError: If the frame has no id image, or the image is unreadable, of another size or of several
                channels, or has too many ids.
        """
        path = self.find_path(frame.index, frame.stamp)
        if path is None:
            raise InputError(
                f"{self.folder}: has no id image for frame {frame.index} at {frame.stamp:.6f} s; {_ADD_ID_IMAGE}"
            )
        values = _read_ids(path)
        if values.shape != frame.image.shape[1:]:
            sizes = [f"{width}x{height}" for height, width in (values.shape, frame.image.shape[1:])]
            raise InputError(
                f"{path}: has {sizes[0]} pixels, its frame {sizes[1]}; write id images of the size of the frames"
            )
        ids = torch.from_numpy(np.bincount(values.ravel())[1:].nonzero()[0] + 1)  # 20 times faster than unique
        if len(ids) > _MAX_INSTANCES:
            raise InputError(
                f"{path}: has {len(ids)} different ids, more than {_MAX_INSTANCES}; an id image has one value for each"
                " instance and 0 for the background, name the folder of such images with --masks"
            )
        labels = torch.full_like(ids, PERSON)
        if self.labels is not None:
            ids = torch.tensor([i for i in ids.tolist() if i in self.labels], dtype=torch.int64)
            labels = torch.tensor([self.labels[i] for i in ids.tolist()], dtype=torch.int64)
        masks = torch.from_numpy(values == ids.numpy()[:, None, None].astype(values.dtype))
        instances = Instances(
            masks=masks,
            labels=labels,
            scores=torch.ones(len(ids), dtype=torch.float32),
            boxes=_bounding_boxes(masks),
        )
        return instances, ids

    def find_path(self, index: int, stamp: float) -> Path | None:
        """Return the path of the id image that belongs to a frame; None if there is none.

        Args:
            index: Position of the frame in its sequence.
            stamp: Timestamp of the frame, seconds.
        """
        if self._stamps is None:
            return self._paths[index] if index < len(self._paths) else None
        gap, nearest = (self._stamps - stamp).abs().min(dim=0)
        return self._paths[int(nearest)] if gap <= self._max_gap else None


def _read_ids(path: Path) -> NDArray[Any]:
    """Values of an id image, whole numbers, shape (H, W); for an image with a palette, the palette indices."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            if image.width * image.height > MAX_PIXELS:
                raise too_large_error(path)
            values = np.asarray(image)
    except InputError:
        raise
    except Exception as error:  # decoders raise exceptions of many types on damaged files
        raise InputError(f"{path}: is not a readable PNG image; write it again") from error
    if values.ndim != 2:
        raise InputError(
            f"{path}: has {values.shape[2]} channels, expected one 8- or 16-bit channel; write it with one channel"
        )
    return values


def _read_labels(path: Path) -> dict[int, int]:
    """Class index of each id."""
    try:
        names = parse_yaml(read_text(path, "labels of an id image are a YAML file"))
    except ValueError as error:
        raise InputError(f"{path}: is not valid YAML ({error}); write a line such as 4: chair for each id") from error
    if not isinstance(names, dict) or not all(type(i) is int and name in COCO_NAMES for i, name in names.items()):
        raise InputError(
            f"{path}: expected a line such as 4: chair for each id, with classes of COCO; correct the file"
        )
    if (smallest := min(names, default=1)) < 1:
        raise InputError(f"{path}: has the id {smallest}, but 0 is the background; number the instances from 1")
    return {i: COCO_NAMES.index(name) for i, name in names.items()}


def _bounding_boxes(masks: Tensor) -> Tensor:
    """Left, top, right and bottom edges of non-empty masks, float32, shape (N, 4)."""
    columns, rows = masks.any(dim=1), masks.any(dim=2)
    left, top = (extent.int().argmax(dim=1) for extent in (columns, rows))
    right, bottom = (extent.shape[1] - extent.flip(1).int().argmax(dim=1) for extent in (columns, rows))
    return torch.stack([left, top, right, bottom], dim=1).to(torch.float32)
