"""One object, one instance: which of those that overlap stay, against a loop over pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.config import SegmentationConfig
from v3d_torch.segmentation import yolo
from v3d_torch.segmentation.duplicates import without_duplicates
from v3d_torch.types import Instances

SHARE = SegmentationConfig().duplicate_overlap
HEIGHT, WIDTH = 48, 64
STRIDE = 4  # pixels between those that are compared
PERSON, CHAIR = 0, 56


def rectangle(left: int, top: int, right: int, bottom: int) -> Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[top:bottom, left:right] = True
    return mask


def instances(masks: Sequence[Tensor], labels: Sequence[int]) -> Instances:
    """The given ones, best first; boxes tell them apart."""
    count = len(masks)
    return Instances(
        masks=torch.stack(list(masks)) if count else torch.zeros(0, HEIGHT, WIDTH, dtype=torch.bool),
        labels=torch.tensor(labels, dtype=torch.int64),
        scores=torch.linspace(0.9, 0.3, count),
        boxes=torch.arange(count)[:, None] + torch.zeros(count, 4),
    )


def kept(masks: Sequence[Tensor], labels: Sequence[int], share: float = SHARE) -> list[int]:
    """Which stay; that all of each stays with it is checked here."""
    before = instances(masks, labels)
    after = without_duplicates(before, share)
    order = [int(box) for box in after.boxes[:, 0]]
    for field in ("masks", "labels", "scores", "boxes"):
        assert torch.equal(getattr(after, field), getattr(before, field)[order])
        assert getattr(after, field).dtype == getattr(before, field).dtype
    return order


WHOLE = rectangle(8, 0, 40, 48)
HEAD = rectangle(16, 0, 32, 12)
OTHER = rectangle(44, 0, 64, 48)


def test_a_part_of_a_person_is_no_second_person() -> None:
    """Boxes do not tell: their intersection over union is an eighth."""
    assert kept([WHOLE, HEAD, OTHER], [PERSON] * 3) == [0, 2]


def test_the_same_seen_twice_is_seen_once() -> None:
    assert kept([WHOLE, WHOLE, OTHER, WHOLE, OTHER], [PERSON] * 5) == [0, 2]


def test_a_part_that_scores_better_does_not_drive_out_the_whole() -> None:
    assert kept([HEAD, WHOLE], [PERSON] * 2) == [0, 1]


def test_another_class_within_stays() -> None:
    assert kept([WHOLE, HEAD, HEAD], [PERSON, CHAIR, PERSON]) == [0, 1]


def test_the_same_pixels_by_another_name_are_the_same_thing() -> None:
    nearly = rectangle(8, 0, 40, 40)
    assert kept([WHOLE, nearly, OTHER], [PERSON, CHAIR, CHAIR]) == [0, 2]
    assert kept([nearly, WHOLE, OTHER], [PERSON, CHAIR, CHAIR]) == [0, 2]


def test_neighbours_that_overlap_a_little_stay() -> None:
    assert kept([rectangle(0, 0, 32, 48), rectangle(16, 0, 48, 48)], [PERSON] * 2) == [0, 1]


@pytest.mark.parametrize(("columns", "stay"), [(11, [0, 1]), (12, [0, 1]), (13, [0]), (16, [0])])
def test_the_share_is_that_of_the_worse(columns: int, stay: list[int]) -> None:
    """Of 16 columns of cells so many lie in the better one, which is much larger."""
    height, width = 4 * STRIDE, 64 * STRIDE
    better, worse = torch.zeros(2, height, width, dtype=torch.bool)
    better[:, : 40 * STRIDE] = True
    worse[:, (40 - columns) * STRIDE : (56 - columns) * STRIDE] = True
    assert kept([better, worse], [PERSON] * 2, share=0.75) == stay


def test_who_is_left_out_leaves_nobody_out() -> None:
    """The second lies in the first, the third in the second but hardly in the first: it stays."""
    first, second, third = rectangle(0, 0, 32, 48), rectangle(8, 0, 40, 48), rectangle(24, 0, 40, 48)
    assert kept([second, third], [PERSON] * 2) == [0]
    assert kept([first, second, third], [PERSON] * 3) == [0, 2]


def test_masks_without_pixels_harm_nobody() -> None:
    nothing = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    assert kept([nothing, WHOLE, nothing], [PERSON] * 3) == [0, 1, 2]


def test_nobody() -> None:
    after = without_duplicates(Instances.empty(HEIGHT, WIDTH), SHARE)
    assert len(after) == 0 and after.masks.shape == (0, HEIGHT, WIDTH) and after.boxes.shape == (0, 4)


def naive(masks: np.ndarray, labels: Sequence[int], share: float) -> list[int]:
    """Pixel by pixel and pair by pair."""
    stay: list[int] = []
    for i in range(len(masks)):
        for j in stay:
            both = area = other = 0
            for v, u in np.ndindex(*masks.shape[1:]):
                if v % STRIDE == 0 and u % STRIDE == 0:
                    both += bool(masks[i, v, u] and masks[j, v, u])
                    area += bool(masks[i, v, u])
                    other += bool(masks[j, v, u])
            coincide = both > share * max(other, 1)
            if both > share * max(area, 1) and (labels[i] == labels[j] or coincide):
                break
        else:
            stay.append(i)
    return stay


@st.composite
def rectangles(draw: st.DrawFn) -> Tensor:
    left, right = sorted(draw(st.tuples(st.integers(0, 23), st.integers(0, 23))))
    top, bottom = sorted(draw(st.tuples(st.integers(0, 15), st.integers(0, 15))))
    mask = torch.zeros(16, 24, dtype=torch.bool)
    mask[top : bottom + 1, left : right + 1] = True
    return mask


SEEN = st.lists(st.tuples(rectangles(), st.sampled_from([PERSON, CHAIR])), min_size=1, max_size=6)
SHARES = st.sampled_from([0.31, 0.53, 0.71])  # no two counts of so few pixels have such a ratio


@settings(max_examples=40, deadline=None)
@given(SEEN, SHARES)
def test_same_as_the_loop(seen: list[tuple[Tensor, int]], share: float) -> None:
    masks, labels = [mask for mask, _ in seen], [label for _, label in seen]
    assert kept(masks, labels, share) == naive(torch.stack(masks).numpy(), labels, share)


@settings(max_examples=40, deadline=None)
@given(SEEN, SHARES)
def test_the_best_stays_and_twice_is_once(seen: list[tuple[Tensor, int]], share: float) -> None:
    masks, labels = [mask for mask, _ in seen], [label for _, label in seen]
    stay = kept(masks, labels, share)
    assert stay[0] == 0
    assert kept([masks[i] for i in stay], [labels[i] for i in stay], share) == list(range(len(stay)))
    assert kept(masks + masks, labels + labels, share)[: len(stay)] == stay


def test_the_segmenter_leaves_duplicates_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that sees a person, and the upper third once more: suppression by boxes leaves both."""
    predictions, prototypes = np.zeros((1, 116, 10), np.float32), np.ones((1, 32, 24, 32), np.float32)
    predictions[0, :4, 0], predictions[0, 4, 0] = (32, 48, 64, 96), 0.9  # centre, size, score of a person
    predictions[0, :4, 1], predictions[0, 4, 1] = (32, 16, 32, 32), 0.8
    predictions[0, 84] = 1.0  # each mask fills its box
    session = SimpleNamespace(get_inputs=lambda: [SimpleNamespace(name="in")], run=lambda *_: (predictions, prototypes))
    monkeypatch.setattr(yolo, "_open_session", lambda *_: session)
    monkeypatch.setattr(yolo, "_check_layout", lambda *_: (96, 128))
    image = torch.zeros(3, 96, 128, dtype=torch.uint8)
    for share, scores in ((SHARE, [0.9]), (1.0, [0.9, 0.8])):
        segmenter = yolo.YOLOSegmenter(SegmentationConfig(duplicate_overlap=share), Path("network.onnx"))
        assert segmenter.segment(image).scores.tolist() == pytest.approx(scores)


def test_what_all_stays_is_not_copied() -> None:
    """Masks are large, and mostly there is nothing to leave out, nor to add."""
    all_ = instances([WHOLE, OTHER], [PERSON, PERSON])
    assert without_duplicates(all_, SHARE) is all_
    assert all_.concatenate(Instances.empty(HEIGHT, WIDTH)) is all_
    assert len(all_[torch.tensor([False, True])]) == 1
