"""Image with pose and mask, the element of all image exports, and its undistortion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.files import write_png
from v3d_torch.types import RGBDFrame

CORNER_OFFSET = 0.5
"""Coordinate of the centre of the first pixel for COLMAP and nerfstudio, pixels: their origin is the corner of the
image. In this package and in OpenCV, pixel centres lie at integers."""


@dataclass(frozen=True)
class PosedImage:
    """Image of a frame with its pose and mask.

    Attributes:
        frame: Frame.
        T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
        static: Pixels that show the static scene without people, bool, shape :math:`(H, W)`.
    """

    frame: RGBDFrame
    T_wc: Tensor
    static: Tensor

    @property
    def name(self) -> str:
        """File name; the names have the order of the frames."""
        return f"frame_{self.frame.index:06d}.png"

    @property
    def static_depth(self) -> Tensor:
        """Depth of the static scene, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement or not static."""
        return torch.where(self.static, self.frame.depth, 0.0)

    def write_colour(self, folder: Path) -> None:
        """Write the colour image to a folder."""
        write_png(folder / self.name, self.frame.image.permute(1, 2, 0).numpy())

    def write_mask(self, path: Path) -> None:
        """Write the mask in the format of reconstruction tools: 255 = static, 0 = ignored."""
        write_png(path, self.static.to(torch.uint8).numpy() * 255)


class Undistorter:
    """Removes the lens distortion of images.

    Args:
        camera: Camera of the images.

    Attributes:
        camera: Camera of the undistorted images: the same camera matrix, without distortion.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self.camera = replace(camera, distortion=(0.0,) * 5, distortion_model="plumb_bob")
        u, v = torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy")
        recorded = camera.distort(torch.stack([u, v], dim=-1).flatten(0, 1)).reshape(camera.height, camera.width, 2)
        self._map_u, self._map_v = (each.numpy() for each in recorded.float().unbind(dim=2))

    def __call__(self, image: PosedImage) -> PosedImage:
        """Undistort an image. Its mask excludes pixels outside of the recorded image.

        Depth and mask are taken from the nearest pixel, so that depth edges stay sharp.
        """
        frame = image.frame
        colour = self._remap(frame.image.permute(1, 2, 0).contiguous(), cv2.INTER_LINEAR)
        depth = self._remap(frame.depth[0], cv2.INTER_NEAREST)
        visible = self._remap(image.static.to(torch.uint8), cv2.INTER_NEAREST) > 0
        undistorted = replace(frame, image=colour.permute(2, 0, 1), depth=depth[None], camera=self.camera)
        return PosedImage(undistorted, image.T_wc, visible)

    def _remap(self, image: Tensor, interpolation: int) -> Tensor:
        """Resample an image (H, W) or (H, W, C); pixels outside of it are 0."""
        return torch.from_numpy(cv2.remap(image.numpy(), self._map_u, self._map_v, interpolation))
