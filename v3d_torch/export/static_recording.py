"""Recording of the static scene: a folder in TUM layout without the depth of moving objects, with masks and poses."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v3d_torch.datasets.tum_trajectory import write_trajectory
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.io.files import write_png
from v3d_torch.io.timestamps import format_timestamp
from v3d_torch.types import RGBDFrame, Trajectory

ESTIMATE = "estimated_trajectory.txt"
"""Name of the file of estimated poses, in the format of ``groundtruth.txt``."""

_MASKS = "moving"
"""Folder of the masks; different from ``masks``, the folder of true masks in a sequence in TUM layout."""


class StaticRecording:
    """Writer of a recording in which the depth of moving objects is 0.

    It also writes a mask of each frame, named by the timestamp of the colour image: 255 where depth was removed.

    Args:
        writer: Writer of the folder.
    """

    def __init__(self, writer: TUMWriter) -> None:
        self._writer = writer

    def add(self, frame: RGBDFrame, static: Tensor) -> None:
        """Write a frame.

        Args:
            frame: Frame.
            static: Pixels that show the static scene without people, bool, shape :math:`(H, W)`.

        Raises:
            OutputError: If a file cannot be written.
        """
        self._writer.add(replace(frame, depth=torch.where(static, frame.depth, 0.0)))
        moving = (~static).to(torch.uint8).numpy() * 255
        write_png(self._writer.folder / _MASKS / f"{format_timestamp(frame.stamp)}.png", moving)

    def write_poses(self, trajectory: Trajectory) -> None:
        """Write the estimated poses.

        Raises:
            OutputError: If the file cannot be written.
        """
        write_trajectory(self._writer.folder / ESTIMATE, trajectory)
