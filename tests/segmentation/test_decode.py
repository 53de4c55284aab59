"""Decoding of the raw network output, against known outputs and a naive version."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from v3d_torch.segmentation.decode import assemble_masks, decode
from v3d_torch.segmentation.inference import WholeOutput
from v3d_torch.segmentation.letterbox import Window

HEIGHT, WIDTH = 96, 128
WHOLE = Window(top=0, left=0, height=HEIGHT, width=WIDTH, image_height=HEIGHT, image_width=WIDTH)


def raw_output(boxes: Tensor, labels: list[int], scores: list[float]) -> tuple[Tensor, Tensor]:
    """Raw output with the given boxes as first predictions; every mask fills its box."""
    predictions = torch.zeros(116, len(labels) + 10)
    predictions[:2, : len(labels)] = ((boxes[:, :2] + boxes[:, 2:]) / 2).T
    predictions[2:4, : len(labels)] = (boxes[:, 2:] - boxes[:, :2]).T
    for column, (label, score) in enumerate(zip(labels, scores, strict=True)):
        predictions[4 + label, column] = score
    predictions[84] = 1.0
    prototypes = torch.ones(32, HEIGHT // 4, WIDTH // 4)
    return predictions, prototypes


def decode_whole(predictions: Tensor, prototypes: Tensor, iou_threshold: float | None = 0.7, max_instances: int = 32):
    return decode(
        WholeOutput(predictions, prototypes),
        WHOLE,
        score_threshold=0.25,
        iou_threshold=iou_threshold,
        max_instances=max_instances,
    )


def test_decode_applies_threshold_and_suppression_and_sorts_by_score() -> None:
    boxes = torch.tensor([[8.0, 8, 40, 40], [60, 10, 100, 50], [61, 10, 100, 50], [61, 10, 100, 50], [0, 0, 9, 9]])
    instances = decode_whole(*raw_output(boxes, [0, 56, 56, 62, 3], [0.5, 0.6, 0.9, 0.3, 0.2]))
    assert instances.labels.tolist() == [56, 0, 62]
    torch.testing.assert_close(instances.scores, torch.tensor([0.9, 0.5, 0.3]))
    torch.testing.assert_close(instances.boxes, boxes[[2, 0, 3]])
    assert instances.masks.shape == (3, HEIGHT, WIDTH)


def test_instances_inside_autocast_equal_those_outside() -> None:
    output = raw_output(torch.tensor([[8.0, 12.0, 20.0, 40.0]]), [0], [0.9])
    with torch.autocast("cpu", torch.bfloat16):
        inside = decode_whole(*output)
    assert torch.equal(inside.masks, decode_whole(*output).masks)


def test_convention_box_contains_pixels_from_left_to_before_right() -> None:
    instances = decode_whole(*raw_output(torch.tensor([[8.0, 12.0, 20.0, 40.0]]), [0], [0.9]))
    expected = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    expected[12:40, 8:20] = True
    assert torch.equal(instances.masks[0], expected)


def test_decode_without_iou_threshold_keeps_overlapping_boxes() -> None:
    raw = raw_output(torch.tensor([[8.0, 8, 40, 40]] * 2), [0, 0], [0.8, 0.7])
    assert len(decode_whole(*raw)) == 1
    assert len(decode_whole(*raw, iou_threshold=None)) == 2


def test_max_instances_keeps_the_best_scores() -> None:
    boxes = torch.tensor([[10.0 * i, 0, 10.0 * i + 9, 9] for i in range(8)])
    scores = [0.3, 0.9, 0.5, 0.4, 0.8, 0.6, 0.35, 0.7]
    assert decode_whole(*raw_output(boxes, [0] * 8, scores), max_instances=3).scores.tolist() == pytest.approx(
        [0.9, 0.8, 0.7]
    )


def test_max_instances_keeps_people_and_animals_first() -> None:
    boxes = torch.tensor([[10.0 * i, 0, 10.0 * i + 9, 9] for i in range(6)])
    chair, person, dog = 56, 0, 16
    labels, scores = [chair, person, chair, dog, chair, person], [0.9, 0.3, 0.8, 0.35, 0.7, 0.26]
    instances = decode_whole(*raw_output(boxes, labels, scores), max_instances=4)
    assert instances.labels.tolist() == [chair, dog, person, person]
    torch.testing.assert_close(instances.boxes, boxes[[0, 3, 1, 5]])


def test_no_prediction_or_empty_mask_gives_no_instance() -> None:
    empty = decode_whole(*raw_output(torch.zeros(0, 4), [], []))
    assert (len(empty), empty.masks.shape, empty.boxes.shape) == (0, (0, HEIGHT, WIDTH), (0, 4))
    predictions, prototypes = raw_output(torch.tensor([[8.0, 8, 40, 40]]), [0], [0.9])
    assert len(decode_whole(predictions, -prototypes)) == 0


@pytest.mark.parametrize(
    "window",
    [
        WHOLE,
        Window(top=0, left=16, height=96, width=96, image_height=300, image_width=310),
        Window(top=12, left=0, height=72, width=128, image_height=50, image_width=90),
    ],
)
def test_masks_equal_full_upsampling_and_cropping(window: Window) -> None:
    generator = torch.Generator().manual_seed(3)
    prototypes = torch.randn(32, HEIGHT // 4, WIDTH // 4, generator=generator)
    coefficients = torch.randn(9, 32, generator=generator)
    size = (window.image_height, window.image_width)
    corners = torch.rand(9, 2, 2, generator=generator).sort(dim=1).values * torch.tensor([size[1], size[0]])
    boxes = corners.flatten(1)
    masks = assemble_masks(coefficients, prototypes, boxes, window)

    visible = prototypes[:, window.top // 4 :, window.left // 4 :][:, : window.height // 4, : window.width // 4]
    logits = functional.interpolate(torch.einsum("np,phw->nhw", coefficients, visible)[None], size, mode="bilinear")[0]
    v, u = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    inside = torch.stack([(u >= a) & (v >= b) & (u < c) & (v < d) for a, b, c, d in boxes])
    is_certain = logits.abs() > 1e-4  # of smaller logits the sign depends on rounding
    assert is_certain.float().mean() > 0.999
    assert torch.equal(masks & is_certain, inside & (logits > 0) & is_certain)
