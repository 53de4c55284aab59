"""Suppression of duplicates: by boxes against kornia, by masks against a loop over pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.bbox import nms
from torch import Tensor

from v3d_torch.config import SegmentationConfig
from v3d_torch.segmentation import inference, yolo
from v3d_torch.segmentation.suppression import non_maximum_suppression, suppress_duplicates
from v3d_torch.types import Instances

MAX_OVERLAP = SegmentationConfig().duplicate_overlap
HEIGHT, WIDTH = 48, 64
STRIDE = 4  # masks are compared on every n-th row and column
PERSON, CHAIR = 0, 56


def rectangle(left: int, top: int, right: int, bottom: int) -> Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[top:bottom, left:right] = True
    return mask


def instances(masks: Sequence[Tensor], labels: Sequence[int]) -> Instances:
    """Instances with the given masks and labels, best first; the edges of box k are k."""
    count = len(masks)
    return Instances(
        masks=torch.stack(list(masks)) if count else torch.zeros(0, HEIGHT, WIDTH, dtype=torch.bool),
        labels=torch.tensor(labels, dtype=torch.int64),
        scores=torch.linspace(0.9, 0.3, count),
        boxes=torch.arange(count)[:, None] + torch.zeros(count, 4),
    )


def remaining(masks: Sequence[Tensor], labels: Sequence[int], max_overlap: float = MAX_OVERLAP) -> list[int]:
    """Positions of the instances that are not suppressed, after a check that their fields are unchanged."""
    before = instances(masks, labels)
    after = suppress_duplicates(before, max_overlap)
    order = [int(box) for box in after.boxes[:, 0]]
    for field in ("masks", "labels", "scores", "boxes"):
        assert torch.equal(getattr(after, field), getattr(before, field)[order])
        assert getattr(after, field).dtype == getattr(before, field).dtype
    return order


def random_boxes(count: int, seed: int) -> Tensor:
    """Edges of boxes, many of which overlap."""
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator) * 40
    return torch.cat([corner, corner + 5 + 30 * torch.rand(count, 2, generator=generator)], dim=1)


@settings(max_examples=40)
@given(count=st.integers(1, 60), seed=st.integers(0, 10_000), threshold=st.sampled_from([0.0, 0.3, 0.7, 1.0]))
def test_non_maximum_suppression_equals_kornia_within_each_class(count: int, seed: int, threshold: float) -> None:
    boxes = random_boxes(count, seed)
    labels = torch.randint(3, (count,), generator=torch.Generator().manual_seed(seed))
    scores = torch.linspace(1, 0.1, count)
    expected = torch.zeros(count, dtype=torch.bool)
    for label in range(3):
        members = torch.nonzero(labels == label)[:, 0]
        if len(members):
            expected[members[nms(boxes[members], scores[members], threshold)]] = True
    assert torch.equal(non_maximum_suppression(boxes, labels, threshold), expected)


def test_non_maximum_suppression_of_a_chain_keeps_every_second_box() -> None:
    """Each box overlaps only its neighbours, so each pass of the batched rule makes one more box final."""
    left = torch.arange(12.0) * 4
    boxes = torch.stack([left, torch.zeros(12), left + 10, torch.full((12,), 10.0)], dim=1)
    keep = non_maximum_suppression(boxes, torch.zeros(12, dtype=torch.int64), 0.4)
    assert keep.tolist() == [True, False] * 6


WHOLE = rectangle(8, 0, 40, 48)
HEAD = rectangle(16, 0, 32, 12)
OTHER = rectangle(44, 0, 64, 48)


def test_part_of_a_person_is_suppressed() -> None:
    """Suppression by boxes would keep both: their intersection over union is one eighth."""
    assert remaining([WHOLE, HEAD, OTHER], [PERSON] * 3) == [0, 2]


def test_repeated_detections_are_suppressed() -> None:
    assert remaining([WHOLE, WHOLE, OTHER, WHOLE, OTHER], [PERSON] * 5) == [0, 2]


def test_part_with_better_score_does_not_suppress_the_whole() -> None:
    assert remaining([HEAD, WHOLE], [PERSON] * 2) == [0, 1]


def test_instance_of_another_class_within_a_mask_is_kept() -> None:
    assert remaining([WHOLE, HEAD, HEAD], [PERSON, CHAIR, PERSON]) == [0, 1]


def test_coinciding_masks_of_two_classes_are_one_object() -> None:
    nearly = rectangle(8, 0, 40, 40)
    assert remaining([WHOLE, nearly, OTHER], [PERSON, CHAIR, CHAIR]) == [0, 2]
    assert remaining([nearly, WHOLE, OTHER], [PERSON, CHAIR, CHAIR]) == [0, 2]


def test_neighbours_with_small_overlap_are_kept() -> None:
    assert remaining([rectangle(0, 0, 32, 48), rectangle(16, 0, 48, 48)], [PERSON] * 2) == [0, 1]


@pytest.mark.parametrize(("columns", "expected"), [(11, [0, 1]), (12, [0, 1]), (13, [0]), (16, [0])])
def test_overlap_is_a_fraction_of_the_worse_instance(columns: int, expected: list[int]) -> None:
    """The given number of its 16 columns of cells lie in the better instance, which is much larger."""
    height, width = 4 * STRIDE, 64 * STRIDE
    better, worse = torch.zeros(2, height, width, dtype=torch.bool)
    better[:, : 40 * STRIDE] = True
    worse[:, (40 - columns) * STRIDE : (56 - columns) * STRIDE] = True
    assert remaining([better, worse], [PERSON] * 2, max_overlap=0.75) == expected


def test_suppressed_instance_suppresses_no_other() -> None:
    """The second lies in the first; the third lies in the second, but hardly in the first, and is kept."""
    first, second, third = rectangle(0, 0, 32, 48), rectangle(8, 0, 40, 48), rectangle(24, 0, 40, 48)
    assert remaining([second, third], [PERSON] * 2) == [0]
    assert remaining([first, second, third], [PERSON] * 3) == [0, 2]


def test_empty_masks_suppress_nothing_and_are_kept() -> None:
    empty = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    assert remaining([empty, WHOLE, empty], [PERSON] * 3) == [0, 1, 2]


def test_no_instances_give_no_instances() -> None:
    after = suppress_duplicates(Instances.empty(HEIGHT, WIDTH), MAX_OVERLAP)
    assert len(after) == 0 and after.masks.shape == (0, HEIGHT, WIDTH) and after.boxes.shape == (0, 4)


def naive(masks: np.ndarray, labels: Sequence[int], max_overlap: float) -> list[int]:
    """Reference implementation, pixel by pixel and pair by pair."""
    keep: list[int] = []
    for i in range(len(masks)):
        for j in keep:
            intersection = area = other = 0
            for v, u in np.ndindex(*masks.shape[1:]):
                if v % STRIDE == 0 and u % STRIDE == 0:
                    intersection += bool(masks[i, v, u] and masks[j, v, u])
                    area += bool(masks[i, v, u])
                    other += bool(masks[j, v, u])
            coincide = intersection > max_overlap * max(other, 1)
            if intersection > max_overlap * max(area, 1) and (labels[i] == labels[j] or coincide):
                break
        else:
            keep.append(i)
    return keep


@st.composite
def rectangles(draw: st.DrawFn) -> Tensor:
    left, right = sorted(draw(st.tuples(st.integers(0, 23), st.integers(0, 23))))
    top, bottom = sorted(draw(st.tuples(st.integers(0, 15), st.integers(0, 15))))
    mask = torch.zeros(16, 24, dtype=torch.bool)
    mask[top : bottom + 1, left : right + 1] = True
    return mask


DETECTIONS = st.lists(st.tuples(rectangles(), st.sampled_from([PERSON, CHAIR])), min_size=1, max_size=6)
MAX_OVERLAPS = st.sampled_from([0.31, 0.53, 0.71])  # not a ratio of two small pixel counts


@settings(max_examples=40)
@given(DETECTIONS, MAX_OVERLAPS)
def test_suppression_by_masks_equals_naive_loop(detections: list[tuple[Tensor, int]], max_overlap: float) -> None:
    masks, labels = [mask for mask, _ in detections], [label for _, label in detections]
    assert remaining(masks, labels, max_overlap) == naive(torch.stack(masks).numpy(), labels, max_overlap)


@settings(max_examples=40)
@given(DETECTIONS, MAX_OVERLAPS)
def test_best_instance_is_kept_and_suppression_is_idempotent(
    detections: list[tuple[Tensor, int]], max_overlap: float
) -> None:
    masks, labels = [mask for mask, _ in detections], [label for _, label in detections]
    keep = remaining(masks, labels, max_overlap)
    assert keep[0] == 0
    assert remaining([masks[i] for i in keep], [labels[i] for i in keep], max_overlap) == list(range(len(keep)))
    assert remaining(masks + masks, labels + labels, max_overlap)[: len(keep)] == keep


def test_segmenter_suppresses_duplicates(monkeypatch: pytest.MonkeyPatch) -> None:
    """The network detects a person and also the upper third of the person: suppression by boxes keeps both."""
    predictions, prototypes = np.zeros((1, 116, 10), np.float32), np.ones((1, 32, 24, 32), np.float32)
    predictions[0, :4, 0], predictions[0, 4, 0] = (32, 48, 64, 96), 0.9  # centre, size, score of a person
    predictions[0, :4, 1], predictions[0, 4, 1] = (32, 16, 32, 32), 0.8
    predictions[0, 84] = 1.0  # each mask fills its box
    session = SimpleNamespace(get_inputs=lambda: [SimpleNamespace(name="in")], run=lambda *_: (predictions, prototypes))
    monkeypatch.setattr(inference, "open_session", lambda *_: session)
    monkeypatch.setattr(inference, "_check_layout", lambda *_: (96, 128))
    image = torch.zeros(3, 96, 128, dtype=torch.uint8)
    for max_overlap, scores in ((MAX_OVERLAP, [0.9]), (1.0, [0.9, 0.8])):
        segmenter = yolo.YOLOSegmenter(SegmentationConfig(duplicate_overlap=max_overlap), Path("network.onnx"))
        assert segmenter.segment(image).scores.tolist() == pytest.approx(scores)


def test_instances_without_duplicates_are_not_copied() -> None:
    """Masks are large, and usually there are no duplicates and no instances to add."""
    all_ = instances([WHOLE, OTHER], [PERSON, PERSON])
    assert suppress_duplicates(all_, MAX_OVERLAP) is all_
    assert all_.concatenate(Instances.empty(HEIGHT, WIDTH)) is all_
    assert len(all_[torch.tensor([False, True])]) == 1


def test_instances_are_selected_by_indices_as_suppression_of_other_libraries_returns_them() -> None:
    all_ = instances([WHOLE, OTHER], [PERSON, CHAIR])
    for indices, labels in (([1], [CHAIR]), ([1, 0], [CHAIR, PERSON]), ([], [])):
        selected = all_[torch.tensor(indices, dtype=torch.int64)]
        assert selected.labels.tolist() == labels and len(selected.masks) == len(labels)
