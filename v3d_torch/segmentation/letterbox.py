"""Letterboxing: an image of any size scaled to fit the network's canvas, centred, on grey padding."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

CELL = 4
"""Side of a prototype cell, canvas pixels. The image covers whole cells, so that masks are cropped exactly."""

_GREY = 114
"""Padding value, as in the training of the networks."""


@dataclass(frozen=True)
class Window:
    """Position of an image on the canvas, pixels.

    Attributes:
        top: First canvas row of the image, a multiple of `CELL`.
        left: First canvas column of the image, a multiple of `CELL`.
        height: Canvas rows that the image covers, a multiple of `CELL`.
        width: Canvas columns that the image covers, a multiple of `CELL`.
        image_height: Rows of the original image.
        image_width: Columns of the original image.
    """

    top: int
    left: int
    height: int
    width: int
    image_height: int
    image_width: int

    def to_image(self, boxes: Tensor) -> Tensor:
        """Transform boxes from the canvas to the image and clip them at its border.

        Args:
            boxes: Left, top, right and bottom edges, canvas pixels, shape :math:`(N, 4)`.

        Returns:
            The same edges in image pixels, shape :math:`(N, 4)`.
        """
        offset = boxes.new_tensor([self.left, self.top, self.left, self.top])
        size = boxes.new_tensor([self.width, self.height, self.width, self.height])
        image_size = boxes.new_tensor([self.image_width, self.image_height, self.image_width, self.image_height])
        return ((boxes - offset) / size * image_size).clamp(min=torch.zeros_like(image_size), max=image_size)


def letterbox(image: Tensor, height: int, width: int) -> tuple[Tensor, Window]:
    """Scale an image to fit a canvas and centre it there.

    Args:
        image: Colour image, uint8 RGB, shape :math:`(3, H, W)`.
        height: Rows of the canvas, a multiple of `CELL`.
        width: Columns of the canvas, a multiple of `CELL`.

    Returns:
        The canvas, float32 in [0, 1], shape :math:`(1, 3, height, width)`, and the position of the image on it.
    """
    image_height, image_width = image.shape[1:]
    scale = min(height / image_height, width / image_width)
    inner_height = min(height, max(CELL, round(image_height * scale / CELL) * CELL))
    inner_width = min(width, max(CELL, round(image_width * scale / CELL) * CELL))
    top = (height - inner_height) // 2 // CELL * CELL
    left = (width - inner_width) // 2 // CELL * CELL
    window = Window(top, left, inner_height, inner_width, image_height, image_width)

    scaled = image[None]  # interpolated as uint8, as in the training of the networks
    if (inner_height, inner_width) != (image_height, image_width):
        scaled = functional.interpolate(scaled, (inner_height, inner_width), mode="bilinear", antialias=True)
    canvas = torch.full((1, 3, height, width), _GREY, dtype=torch.uint8)
    canvas[..., top : top + inner_height, left : left + inner_width] = scaled
    return canvas.to(torch.float32).div_(255), window
