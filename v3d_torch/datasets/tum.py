"""Folders in the layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from v3d_torch.datasets.cameras import CameraChoice, PublishedCamera
from v3d_torch.datasets.gravity_file import GRAVITY_FILE, read_gravity_file
from v3d_torch.datasets.images import image_size
from v3d_torch.datasets.lists import ImagePair, check_stamp_unit, pair_lists, read_associations
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.datasets.png import decode_png
from v3d_torch.datasets.sequence_names import folder_label
from v3d_torch.datasets.tum_trajectory import read_groundtruth
from v3d_torch.errors import InputError
from v3d_torch.io.image_file import MAX_PIXELS


class TUMSequence(PairedImages):
    """Sequence with ``associations.txt``, or ``rgb.txt`` and ``depth.txt``.

    Ground truth is read from ``groundtruth.txt``, and the direction of gravity at the first frame from ``gravity.txt``,
    which `TUMWriter` writes if it was measured. A subfolder ``masks`` can contain ground-truth motion masks for
    evaluation, with the names of the depth images.

    Args:
        folder: Folder of the sequence.
        camera: A camera, the name of a preset or a camera file; None for the camera of the folder (`choose_camera`).
        published: Function that gives the camera of all sequences of a data set in this layout; None for the TUM RGB-D
            benchmark.
        name: Name used in tables; None to derive it from the folder's name.

    Raises:
        InputError: If the folder or one of its files is missing or invalid.
    """

    def __init__(
        self,
        folder: Path,
        camera: CameraChoice = None,
        *,
        published: PublishedCamera | None = None,
        name: str | None = None,
    ) -> None:
        if not folder.is_dir():
            cause = "is not a folder" if folder.exists() else "does not exist"
            raise InputError(f"{folder}: {cause}; pass a folder with rgb.txt and depth.txt")
        pairs, note = _read_pairs(folder)
        check_stamp_unit(pairs, folder)
        groundtruth = folder / "groundtruth.txt"
        super().__init__(
            folder,
            pairs,
            camera,
            lambda: read_groundtruth(groundtruth) if groundtruth.is_file() else None,
            published=published,
            name=folder_label(folder.resolve().name) if name is None else name,
            pairing_note=note,
        )
        if (gravity := folder / GRAVITY_FILE).is_file():
            self.gravity = read_gravity_file(gravity, float(self.stamps[0]))

    def motion_mask(self, index: int) -> Tensor | None:
        """Read the ground-truth motion mask of frame ``index``; None if there is no such file.

        Returns:
            Mask, uint8, shape :math:`(H, W)`, see `HasMotionMasks.motion_mask`.

        Raises:
            InputError: If the mask is damaged, not 8-bit greyscale or not of the camera's size.
        """
        path = (self.folder / "masks" / Path(self._pairs[index].depth).name).with_suffix(".png")
        if not path.is_file():
            return None
        image_size(path)
        try:
            ids = decode_png(path.read_bytes(), MAX_PIXELS)
            if ids.dtype != np.uint8 or ids.shape[2] != 1:
                raise ValueError("it is another kind of image")
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path}: is truncated or not an 8-bit greyscale motion mask; copy it again, or rename the folder masks"
                " if it contains something else"
            ) from error
        return self._check_size(path, torch.from_numpy(ids).permute(2, 0, 1))[0]


def _read_pairs(folder: Path) -> tuple[list[ImagePair], str | None]:
    if (folder / "associations.txt").is_file():
        return read_associations(folder / "associations.txt")
    return pair_lists(folder / "rgb.txt", folder / "depth.txt")
