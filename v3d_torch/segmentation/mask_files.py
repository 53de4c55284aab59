"""Instances from a folder of id images instead of a network."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.segmentation.coco import PERSON
from v3d_torch.types import Instances, RGBDFrame

_MAX_GAP = 0.02
"""Longest time between a mask and its frame, seconds: what TUM's tools allow between colour and depth."""

_MAX_IDS = 255
"""Most instances in an image: depth taken for ids would make thousands, and a mask of the image's size for each."""

_STAMP = re.compile(r"\d+\.\d+")


class MaskFolder:
    """Id images: a PNG of one channel per frame, 8 or 16 bit, 0 = background, any other value an instance.

    Files whose names are stamps (``1305031102.175304.png``) belong to the frame nearest in time, at most 0.02 s away;
    files with other names belong to the frames in their order.

    Args:
        folder: holds the images.

    Raises:
        InputError: if there is no such folder or no PNG in it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._paths: list[Path] = []
        with suppress(OSError):  # a name that is too long
            self._paths = sorted(folder.glob("*.png"))
        if not self._paths:
            raise InputError(f"{folder}: holds no PNG files; name the folder of the id images with --masks")
        self._stamps: Tensor | None = None
        if all(_STAMP.fullmatch(path.stem) for path in self._paths):
            self._stamps = torch.tensor([float(path.stem) for path in self._paths], dtype=torch.float64)

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Instances of a frame, in the order of their ids; each is a person with score 1, as the file does not say.

        Raises:
            InputError: if the frame has no id image, or it cannot be read or has another size.
        """
        return self.read(frame)[0]

    def read(self, frame: RGBDFrame) -> tuple[Instances, Tensor]:
        """Instances of a frame and their ids in the file, int64, shape :math:`(N,)`.

        Raises:
            InputError: as `__call__`.
        """
        path = self._path(frame)
        values = _read_ids(path)
        if values.shape != frame.image.shape[1:]:
            sizes = [f"{width}x{height}" for height, width in (values.shape, frame.image.shape[1:])]
            raise InputError(
                f"{path}: has {sizes[0]} pixels, its frame {sizes[1]}; write id images of the size of the frames"
            )
        present = values.unique()
        ids = present[present > 0]
        if len(ids) > _MAX_IDS:
            raise InputError(
                f"{path}: has {len(ids)} different values; an id image has one for each instance and 0 for the rest,"
                " name the folder of such images with --masks"
            )
        masks = values == ids[:, None, None]
        instances = Instances(
            masks=masks,
            labels=torch.full_like(ids, PERSON),
            scores=torch.ones(len(ids)),
            boxes=_boxes(masks),
        )
        return instances, ids

    def _path(self, frame: RGBDFrame) -> Path:
        if self._stamps is None:
            if frame.index < len(self._paths):
                return self._paths[frame.index]
        else:
            gap, nearest = (self._stamps - frame.stamp).abs().min(dim=0)
            if gap <= _MAX_GAP:
                return self._paths[int(nearest)]
        raise InputError(
            f"{self.folder}: has no id image for frame {frame.index} at {frame.stamp:.6f} s;"
            " add it, or name the folder that belongs to this sequence"
        )


def _read_ids(path: Path) -> Tensor:
    """Values of an id image, int64, shape :math:`(H, W)`; of an image with a palette, the indices."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            values = np.asarray(image)
    except Exception as error:  # a decoder that meets nonsense raises whatever that leads to
        raise InputError(f"{path}: cannot be read as an image; write it again") from error
    if values.ndim != 2:
        raise InputError(f"{path}: has {values.shape[2]} channels, an id image has one of 8 or 16 bit; write it so")
    return torch.from_numpy(values.astype(np.int64))


def _boxes(masks: Tensor) -> Tensor:
    """Edges of the masks' extents, left, top, right, bottom, shape :math:`(N, 4)`."""
    columns, rows = masks.any(dim=1), masks.any(dim=2)
    left, top = (extent.int().argmax(dim=1) for extent in (columns, rows))
    right, bottom = (extent.shape[1] - extent.flip(1).int().argmax(dim=1) for extent in (columns, rows))
    return torch.stack([left, top, right, bottom], dim=1).to(torch.float32)
