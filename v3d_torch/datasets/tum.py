"""A folder in the layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012)."""

from __future__ import annotations

from pathlib import Path

import torch
from kornia_rs import io
from torch import Tensor

from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.images import image_size
from v3d_torch.datasets.lists import ImagePair, pair_lists, read_associations, refuse_other_units
from v3d_torch.datasets.names import short_name
from v3d_torch.datasets.paired import PairedImages
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError


class TUMSequence(PairedImages):
    """Frames of a folder with ``associations.txt``, or ``rgb.txt`` and ``depth.txt``.

    A folder ``masks`` in it holds true masks, for evaluation, under the names of the depth images.

    Args:
        folder: the sequence's folder; a ``groundtruth.txt`` in it is read, too.
        camera: a camera, a preset's name or a camera file; None takes what the folder says (see `choose_camera`).
        name: for tables; None makes it from the folder's name.

    Raises:
        InputError: the folder or one of its files is missing or wrong; the message names it and the cure.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None, *, name: str | None = None) -> None:
        if not folder.is_dir():
            what = "is a file" if folder.exists() else "is not there"
            raise InputError(f"{folder}: {what}; a sequence is a folder with rgb.txt and depth.txt")
        pairs = _read_pairs(folder)
        refuse_other_units(pairs, folder)
        truth = folder / "groundtruth.txt"
        super().__init__(
            folder,
            pairs,
            choose_camera(camera, folder),
            lambda: read_trajectory(truth) if truth.is_file() else None,
            name=short_name(folder.resolve().name) if name is None else name,
        )

    def motion_mask(self, index: int) -> Tensor | None:
        """True mask of frame ``index``, see `HasMotionMasks`; None where there is no such file.

        Raises:
            InputError: it is broken, not 8-bit grey or not of the camera's size.
        """
        path = (self.folder / "masks" / Path(self._pairs[index].depth).name).with_suffix(".png")
        if not path.is_file():
            return None
        image_size(path)
        try:
            ids = io.read_image_png_u8(str(path), "mono")
        except Exception as error:  # kornia_rs raises bare Exception for every cause
            raise InputError(
                f"{path}: is truncated or not 8-bit grey, as a true mask is; copy it again, or give the folder masks"
                " another name where it holds something else"
            ) from error
        return self._sized(path, torch.from_numpy(ids).permute(2, 0, 1))[0]


def is_tum(path: Path) -> bool:
    """Whether a folder has one of the lists of the TUM layout; opening it tells which are missing."""
    return any((path / name).is_file() for name in ("associations.txt", "rgb.txt", "depth.txt"))


def _read_pairs(folder: Path) -> list[ImagePair]:
    if (folder / "associations.txt").is_file():
        return read_associations(folder / "associations.txt")
    return pair_lists(folder / "rgb.txt", folder / "depth.txt")
