"""Raw output of the network to instances: threshold, suppression, masks from prototypes."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn import functional

from v3d_torch.segmentation.letterbox import CELL, Window
from v3d_torch.types import Instances

_MAX_CANDIDATES = 1024
"""Best-scored predictions that are looked at: bounds the table of overlaps, far above what passes any threshold."""

_BOX = 4
"""Rows of the raw output that hold the box; class scores and the 32 mask coefficients follow."""


def decode(
    predictions: Tensor,
    prototypes: Tensor,
    window: Window,
    *,
    score_threshold: float,
    iou_threshold: float | None,
    max_instances: int,
) -> Instances:
    """Decode the raw output for one image.

    Args:
        predictions: float32, shape :math:`(4 + C + P, N)`: centre x, centre y, width and height of the box in pixels
            of the canvas, scores of C classes, coefficients of P prototypes.
        prototypes: float32, shape :math:`(P, h, w)`, a cell per 4 x 4 pixels of the canvas.
        window: where the image lies on the canvas.
        score_threshold: least score.
        iou_threshold: boxes of one class that overlap more are one instance; None leaves all (one-to-one heads).
        max_instances: most instances, by score.

    Returns:
        Instances of the image, best score first, each with at least one pixel.
    """
    mask_channels = prototypes.shape[0]
    class_scores = predictions[_BOX:-mask_channels]
    scores = class_scores.amax(dim=0)
    candidates = torch.nonzero(scores >= score_threshold)[:, 0]
    order = candidates[scores[candidates].argsort(descending=True, stable=True)[:_MAX_CANDIDATES]]
    boxes, labels = _corners(predictions[:_BOX, order].T), class_scores[:, order].argmax(dim=0)
    if iou_threshold is not None:
        kept = non_maximum_suppression(boxes, labels, iou_threshold)
        order, boxes, labels = order[kept], boxes[kept], labels[kept]
    order, boxes, labels = order[:max_instances], window.to_image(boxes[:max_instances]), labels[:max_instances]

    masks = assemble_masks(predictions[-mask_channels:, order].T, prototypes, boxes, window)
    seen = masks.view(torch.uint8).flatten(1).amax(dim=1).bool()
    return Instances(masks=masks, labels=labels, scores=scores[order], boxes=boxes)[seen]


def non_maximum_suppression(boxes: Tensor, labels: Tensor, iou_threshold: float) -> Tensor:
    """Greedy suppression within each class, for all boxes at once.

    A box stays if no better box that stays overlaps it. The rule is applied to all boxes together until nothing
    changes: after pass n the first n boxes are decided, in practice three or four passes decide all.

    Args:
        boxes: left, top, right, bottom, best score first, shape :math:`(N, 4)`.
        labels: shape :math:`(N,)`.
        iou_threshold: intersection over union above which two boxes overlap.

    Returns:
        Which boxes stay, bool, shape :math:`(N,)`.
    """
    overlaps = (_iou(boxes) > iou_threshold) & (labels[:, None] == labels)
    suppresses = overlaps.triu(diagonal=1)  # [i, j]: i is better than j and overlaps it
    stays = torch.ones_like(labels, dtype=torch.bool)
    while True:
        decided = ~(suppresses & stays[:, None]).any(dim=0)
        if torch.equal(decided, stays):
            return stays
        stays = decided


def assemble_masks(coefficients: Tensor, prototypes: Tensor, boxes: Tensor, window: Window) -> Tensor:
    """Masks as linear combinations of prototypes, enlarged to the image and cut at their boxes (YOLACT, Sec. 3.1).

    Args:
        coefficients: shape :math:`(N, P)`.
        prototypes: shape :math:`(P, h, w)`.
        boxes: left, top, right, bottom in pixels of the image, shape :math:`(N, 4)`.
        window: where the image lies on the canvas.

    Returns:
        bool, shape :math:`(N, H, W)`.
    """
    # Enlarging is linear and separable: mask = R L C with R (H x h) and C (w x W), of which a box needs a block each.
    enlarge_rows = _enlargement(window.height // CELL, window.image_height)
    enlarge_columns = _enlargement(window.width // CELL, window.image_width)
    top, left = window.top // CELL, window.left // CELL
    logits = (coefficients @ prototypes.flatten(1)).unflatten(1, prototypes.shape[1:])
    logits = logits[:, top : top + enlarge_rows.shape[1], left : left + enlarge_columns.shape[1]]

    masks = torch.zeros(len(boxes), window.image_height, window.image_width, dtype=torch.bool)
    first, last = boxes.ceil().long().chunk(2, dim=1)  # pixel u is inside where left <= u < right
    for mask, cells, (u0, v0), (u1, v1) in zip(masks, logits, first.tolist(), last.tolist(), strict=True):
        rows, cell_rows = enlarge_rows[v0:v1], _cells(v0, v1, enlarge_rows)
        columns, cell_columns = enlarge_columns[u0:u1], _cells(u0, u1, enlarge_columns)
        enlarged = rows[:, cell_rows] @ cells[cell_rows, cell_columns] @ columns[:, cell_columns].T
        mask[v0:v1, u0:u1] = enlarged > 0  # sigmoid above one half
    return masks


@cache
@torch.inference_mode(False)  # what is kept may be wanted where gradients are
def _enlargement(cells: int, pixels: int) -> Tensor:
    """Linear interpolation from cells to pixels that cover the same extent, as a matrix (pixels, cells)."""
    return functional.interpolate(torch.eye(cells)[None], pixels, mode="linear")[0].T


def _cells(first: int, last: int, enlargement: Tensor) -> slice:
    """The cells that pixels from ``first`` to before ``last`` are interpolated from, a neighbour more on each side."""
    pixels, cells = enlargement.shape
    return slice(max(first * cells // pixels - 1, 0), last * cells // pixels + 2)


def _corners(boxes: Tensor) -> Tensor:
    centre, size = boxes[:, :2], boxes[:, 2:]
    return torch.cat([centre - size / 2, centre + size / 2], dim=1)


def _iou(boxes: Tensor) -> Tensor:
    least = torch.maximum(boxes[:, None, :2], boxes[:, :2])
    most = torch.minimum(boxes[:, None, 2:], boxes[:, 2:])
    shared = (most - least).clamp(min=0).prod(dim=2)
    area = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1)
    return shared / (area[:, None] + area - shared)
