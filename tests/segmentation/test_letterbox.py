"""Letterboxing of images on the network's canvas."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.segmentation.letterbox import Window, letterbox


@settings(max_examples=60)
@given(image_height=st.integers(20, 1200), image_width=st.integers(20, 1200))
def test_window_covers_exactly_the_image_and_maps_back_to_its_edges(image_height: int, image_width: int) -> None:
    canvas, window = letterbox(torch.full((3, image_height, image_width), 255, dtype=torch.uint8), 96, 128)
    assert canvas.shape == (1, 3, 96, 128)
    white = (canvas[0] > 0.99).all(dim=0)
    v, u = torch.nonzero(white).T
    assert (v.min(), u.min()) == (window.top, window.left)
    assert (v.max() + 1, u.max() + 1) == (window.top + window.height, window.left + window.width)
    assert white.sum() == window.height * window.width
    edges = torch.tensor([[u.min(), v.min(), u.max() + 1, v.max() + 1]], dtype=torch.float32)
    torch.testing.assert_close(
        window.to_image(edges), torch.tensor([[0.0, 0.0, image_width, image_height]]), rtol=1e-5, atol=1e-3
    )


def test_boxes_are_clipped_at_the_border_of_the_image() -> None:
    _, window = letterbox(torch.zeros(3, 60, 160, dtype=torch.uint8), 96, 128)
    boxes = window.to_image(torch.tensor([[-5.0, 0.0, 64.0, 48.0], [64.0, 48.0, 140.0, 96.0]]))
    torch.testing.assert_close(boxes, torch.tensor([[0.0, 0.0, 80.0, 30.0], [80.0, 30.0, 160.0, 60.0]]))


def test_image_of_canvas_size_is_not_resampled() -> None:
    image = torch.randint(256, (3, 96, 128), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    canvas, window = letterbox(image, 96, 128)
    assert window == Window(top=0, left=0, height=96, width=128, image_height=96, image_width=128)
    assert torch.equal(canvas[0], image.float() / 255)
