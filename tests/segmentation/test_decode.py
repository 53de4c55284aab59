"""Decoding of the raw head and the letterbox, against naive versions and other libraries."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.bbox import nms
from torch import Tensor
from torch.nn import functional

from v3d_torch.segmentation.decode import assemble_masks, decode, non_maximum_suppression
from v3d_torch.segmentation.letterbox import Window, letterbox

HEIGHT, WIDTH = 96, 128
WHOLE = Window(top=0, left=0, height=HEIGHT, width=WIDTH, image_height=HEIGHT, image_width=WIDTH)


def random_boxes(count: int, seed: int) -> Tensor:
    """Corners of boxes that overlap a lot."""
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator) * 40
    return torch.cat([corner, corner + 5 + 30 * torch.rand(count, 2, generator=generator)], dim=1)


def raw_output(boxes: Tensor, labels: list[int], scores: list[float]) -> tuple[Tensor, Tensor]:
    """A raw output whose first predictions are the given ones; every mask fills its box."""
    predictions = torch.zeros(116, len(labels) + 10)
    predictions[:2, : len(labels)] = ((boxes[:, :2] + boxes[:, 2:]) / 2).T
    predictions[2:4, : len(labels)] = (boxes[:, 2:] - boxes[:, :2]).T
    for column, (label, score) in enumerate(zip(labels, scores, strict=True)):
        predictions[4 + label, column] = score
    predictions[84] = 1.0
    prototypes = torch.ones(32, HEIGHT // 4, WIDTH // 4)
    return predictions, prototypes


def run(predictions: Tensor, prototypes: Tensor, iou_threshold: float | None = 0.7, max_instances: int = 32):
    return decode(
        predictions,
        prototypes,
        WHOLE,
        score_threshold=0.25,
        iou_threshold=iou_threshold,
        max_instances=max_instances,
    )


@settings(max_examples=40, deadline=None)
@given(count=st.integers(1, 60), seed=st.integers(0, 10_000), threshold=st.sampled_from([0.0, 0.3, 0.7, 1.0]))
def test_suppression_equals_kornia_class_by_class(count: int, seed: int, threshold: float) -> None:
    boxes = random_boxes(count, seed)
    labels = torch.randint(3, (count,), generator=torch.Generator().manual_seed(seed))
    scores = torch.linspace(1, 0.1, count)
    expected = torch.zeros(count, dtype=torch.bool)
    for label in range(3):
        members = torch.nonzero(labels == label)[:, 0]
        if len(members):
            expected[members[nms(boxes[members], scores[members], threshold)]] = True
    assert torch.equal(non_maximum_suppression(boxes, labels, threshold), expected)


def test_suppression_of_a_chain_keeps_every_other_box() -> None:
    """Each box overlaps only its neighbours, so each pass of the batched rule decides one box more."""
    left = torch.arange(12.0) * 4
    boxes = torch.stack([left, torch.zeros(12), left + 10, torch.full((12,), 10.0)], dim=1)
    stays = non_maximum_suppression(boxes, torch.zeros(12, dtype=torch.int64), 0.4)
    assert stays.tolist() == [True, False] * 6


def test_decode_sorts_thresholds_and_suppresses() -> None:
    boxes = torch.tensor([[8.0, 8, 40, 40], [60, 10, 100, 50], [61, 10, 100, 50], [61, 10, 100, 50], [0, 0, 9, 9]])
    instances = run(*raw_output(boxes, [0, 56, 56, 62, 3], [0.5, 0.6, 0.9, 0.3, 0.2]))
    assert instances.labels.tolist() == [56, 0, 62]
    torch.testing.assert_close(instances.scores, torch.tensor([0.9, 0.5, 0.3]))
    torch.testing.assert_close(instances.boxes, boxes[[2, 0, 3]])
    assert instances.masks.shape == (3, HEIGHT, WIDTH)


def test_convention_a_box_holds_the_pixels_from_left_to_before_right() -> None:
    instances = run(*raw_output(torch.tensor([[8.0, 12.0, 20.0, 40.0]]), [0], [0.9]))
    expected = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    expected[12:40, 8:20] = True
    assert torch.equal(instances.masks[0], expected)


def test_one_to_one_heads_are_not_suppressed() -> None:
    raw = raw_output(torch.tensor([[8.0, 8, 40, 40]] * 2), [0, 0], [0.8, 0.7])
    assert len(run(*raw)) == 1
    assert len(run(*raw, iou_threshold=None)) == 2


def test_most_instances_are_the_best() -> None:
    boxes = torch.tensor([[10.0 * i, 0, 10.0 * i + 9, 9] for i in range(8)])
    scores = [0.3, 0.9, 0.5, 0.4, 0.8, 0.6, 0.35, 0.7]
    assert run(*raw_output(boxes, [0] * 8, scores), max_instances=3).scores.tolist() == pytest.approx([0.9, 0.8, 0.7])


def test_nothing_found_and_nothing_visible_are_empty() -> None:
    nothing = run(*raw_output(torch.zeros(0, 4), [], []))
    assert (len(nothing), nothing.masks.shape, nothing.boxes.shape) == (0, (0, HEIGHT, WIDTH), (0, 4))
    predictions, prototypes = raw_output(torch.tensor([[8.0, 8, 40, 40]]), [0], [0.9])
    assert len(run(predictions, -prototypes)) == 0


@pytest.mark.parametrize(
    "window",
    [
        WHOLE,
        Window(top=0, left=16, height=96, width=96, image_height=300, image_width=310),
        Window(top=12, left=0, height=72, width=128, image_height=50, image_width=90),
    ],
)
def test_masks_equal_enlarging_everything_and_cutting(window: Window) -> None:
    generator = torch.Generator().manual_seed(3)
    prototypes = torch.randn(32, HEIGHT // 4, WIDTH // 4, generator=generator)
    coefficients = torch.randn(9, 32, generator=generator)
    size = (window.image_height, window.image_width)
    corners = torch.rand(9, 2, 2, generator=generator).sort(dim=1).values * torch.tensor([size[1], size[0]])
    boxes = corners.flatten(1)
    masks = assemble_masks(coefficients, prototypes, boxes, window)

    shown = prototypes[:, window.top // 4 :, window.left // 4 :][:, : window.height // 4, : window.width // 4]
    logits = functional.interpolate(torch.einsum("np,phw->nhw", coefficients, shown)[None], size, mode="bilinear")[0]
    v, u = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    inside = torch.stack([(u >= a) & (v >= b) & (u < c) & (v < d) for a, b, c, d in boxes])
    clear = logits.abs() > 1e-4  # elsewhere rounding decides
    assert clear.float().mean() > 0.999
    assert torch.equal(masks & clear, inside & (logits > 0) & clear)


@settings(max_examples=60, deadline=None)
@given(image_height=st.integers(20, 1200), image_width=st.integers(20, 1200))
def test_letterbox_and_back(image_height: int, image_width: int) -> None:
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


def test_an_image_of_the_canvas_size_is_only_scaled_in_value() -> None:
    image = torch.randint(256, (3, 96, 128), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    canvas, window = letterbox(image, 96, 128)
    assert window == WHOLE
    assert torch.equal(canvas[0], image.float() / 255)
