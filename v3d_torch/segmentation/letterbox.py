"""An image of any size on the network's canvas: scaled to fit, centred, the rest grey."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

CELL = 4
"""Pixels of the canvas per prototype cell: the picture covers whole cells, so that masks are cut out exactly."""

_GREY = 114
"""The padding that the networks were trained with."""


@dataclass(frozen=True)
class Window:
    """Where the image lies on the canvas; all pixels, all multiples of `CELL` except the image's own size."""

    top: int
    left: int
    height: int
    width: int
    image_height: int
    image_width: int

    def to_image(self, boxes: Tensor) -> Tensor:
        """Boxes (left, top, right, bottom) on the canvas to the image, cut at its border; shape :math:`(N, 4)`."""
        offset = boxes.new_tensor([self.left, self.top, self.left, self.top])
        size = boxes.new_tensor([self.width, self.height, self.width, self.height])
        image_size = boxes.new_tensor([self.image_width, self.image_height, self.image_width, self.image_height])
        return ((boxes - offset) / size * image_size).clamp(min=torch.zeros_like(image_size), max=image_size)


def letterbox(image: Tensor, height: int, width: int) -> tuple[Tensor, Window]:
    """Put an image on a canvas.

    Args:
        image: uint8 RGB, shape :math:`(3, H, W)`.
        height: rows of the canvas, a multiple of `CELL`.
        width: columns of the canvas, a multiple of `CELL`.

    Returns:
        The canvas, float32 in [0, 1], shape :math:`(1, 3, height, width)`, and where the image lies on it.
    """
    image_height, image_width = image.shape[1:]
    scale = min(height / image_height, width / image_width)
    inner_height = min(height, max(CELL, round(image_height * scale / CELL) * CELL))
    inner_width = min(width, max(CELL, round(image_width * scale / CELL) * CELL))
    top = (height - inner_height) // 2 // CELL * CELL
    left = (width - inner_width) // 2 // CELL * CELL
    window = Window(top, left, inner_height, inner_width, image_height, image_width)

    picture = image[None]  # scaled as bytes, as when the networks were trained
    if (inner_height, inner_width) != (image_height, image_width):
        picture = functional.interpolate(picture, (inner_height, inner_width), mode="bilinear", antialias=True)
    canvas = torch.full((1, 3, height, width), _GREY, dtype=torch.uint8)
    canvas[..., top : top + inner_height, left : left + inner_width] = picture
    return canvas.to(torch.float32).div_(255), window
