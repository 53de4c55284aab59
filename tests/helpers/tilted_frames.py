"""Frames of a tilted camera, and a segmenter that recognises upright images."""

from __future__ import annotations

import torch

from v3d_torch.types import Instances, RGBDFrame

HEIGHT, WIDTH = 24, 32

IDENTITY = torch.eye(4, dtype=torch.float64)


def make_frame(index: int, upright_turns: int | None) -> RGBDFrame:
    """Frame whose upper edge is bright after the given counterclockwise quarter turns; None for a dark image."""
    portrait = (upright_turns or 0) % 2 == 1
    image = torch.zeros(3, WIDTH, HEIGHT, dtype=torch.uint8) if portrait else torch.zeros(3, HEIGHT, WIDTH).byte()
    if upright_turns is not None:
        image[:, :2, : image.shape[2]] = 255
        image = torch.rot90(image, -upright_turns, dims=(1, 2)).contiguous()
    assert image.shape == (3, HEIGHT, WIDTH)
    return RGBDFrame(index, index / 30, image, torch.ones(1, HEIGHT, WIDTH))


class Network:
    """Segmenter with one detection in the upper left corner: label 0 if the upper edge is bright, else a doubtful 1."""

    def __init__(self, confident: float = 0.9, doubtful: float = 0.3) -> None:
        self.sizes: list[tuple[int, int]] = []
        self._scores = confident, doubtful

    def __call__(self, frame: RGBDFrame) -> Instances:
        height, width = frame.image.shape[1:]
        assert frame.depth.shape == (1, height, width)
        self.sizes.append((height, width))
        masks = torch.zeros(1, height, width, dtype=torch.bool)
        masks[0, 2:5, 3:9] = True
        is_upright = bool((frame.image[:, 0] == 255).all())
        score = self._scores[0] if is_upright else self._scores[1]
        boxes = torch.tensor([[3.0, 2, 9, 5]])
        return Instances(masks, torch.tensor([int(not is_upright)]), torch.tensor([score]), boxes)
