"""Decoding of the raw network output into instances: threshold, suppression, masks from prototypes."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn import functional

from v3d_torch.segmentation.letterbox import CELL, Window
from v3d_torch.segmentation.suppression import non_maximum_suppression
from v3d_torch.types import Instances

_MAX_CANDIDATES = 1024
"""Largest number of predictions that enter suppression: bounds its N x N matrix of overlaps, and is far above the
number of predictions that pass a useful score threshold."""

_BOX = 4
"""Rows of the raw output that hold the box; class scores and mask coefficients follow."""


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
        predictions: Raw predictions, float32, shape :math:`(4 + C + P, N)`: centre x, centre y, width and height of the
            box in canvas pixels, scores of C classes, coefficients of P prototypes.
        prototypes: Mask prototypes, float32, shape :math:`(P, h, w)`; each cell covers 4 x 4 canvas pixels.
        window: Position of the image on the canvas.
        score_threshold: Minimum class score.
        iou_threshold: Intersection over union above which two boxes of one class are the same instance; None disables
            suppression, for one-to-one heads.
        max_instances: Maximum number of instances; those with the best scores are kept.

    Returns:
        Instances in the image, best score first, each with at least one pixel.
    """
    mask_channels = prototypes.shape[0]
    class_scores = predictions[_BOX:-mask_channels]
    scores = class_scores.amax(dim=0)
    candidates = torch.nonzero(scores >= score_threshold)[:, 0]
    order = candidates[scores[candidates].argsort(descending=True, stable=True)[:_MAX_CANDIDATES]]
    boxes, labels = _edges(predictions[:_BOX, order].T), class_scores[:, order].argmax(dim=0)
    if iou_threshold is not None:
        keep = non_maximum_suppression(boxes, labels, iou_threshold)
        order, boxes, labels = order[keep], boxes[keep], labels[keep]
    order, boxes, labels = order[:max_instances], window.to_image(boxes[:max_instances]), labels[:max_instances]

    masks = assemble_masks(predictions[-mask_channels:, order].T, prototypes, boxes, window)
    not_empty = masks.view(torch.uint8).flatten(1).amax(dim=1).bool()
    return Instances(masks=masks, labels=labels, scores=scores[order], boxes=boxes)[not_empty]


def assemble_masks(coefficients: Tensor, prototypes: Tensor, boxes: Tensor, window: Window) -> Tensor:
    """Masks as linear combinations of prototypes, upsampled to the image and cropped to their boxes.

    Source: YOLACT (Bolya et al., ICCV 2019), Sec. 3.1.

    Args:
        coefficients: Prototype coefficients of each instance, shape :math:`(N, P)`.
        prototypes: Mask prototypes, shape :math:`(P, h, w)`.
        boxes: Left, top, right and bottom edges, image pixels, shape :math:`(N, 4)`.
        window: Position of the image on the canvas.

    Returns:
        Instance masks, bool, shape :math:`(N, H, W)`.
    """
    # Upsampling is linear and separable: mask = R L C with R (H x h) and C (w x W). A box needs only a block of each.
    upsample_rows = _upsampling_matrix(window.height // CELL, window.image_height)
    upsample_columns = _upsampling_matrix(window.width // CELL, window.image_width)
    top, left = window.top // CELL, window.left // CELL
    logits = (coefficients @ prototypes.flatten(1)).unflatten(1, prototypes.shape[1:])
    logits = logits[:, top : top + upsample_rows.shape[1], left : left + upsample_columns.shape[1]]

    masks = torch.zeros(len(boxes), window.image_height, window.image_width, dtype=torch.bool)
    first, last = boxes.ceil().long().chunk(2, dim=1)  # pixel u is inside the box if left <= u < right
    for mask, cells, (u0, v0), (u1, v1) in zip(masks, logits, first.tolist(), last.tolist(), strict=True):
        rows, cell_rows = upsample_rows[v0:v1], _cell_range(v0, v1, upsample_rows)
        columns, cell_columns = upsample_columns[u0:u1], _cell_range(u0, u1, upsample_columns)
        upsampled = rows[:, cell_rows] @ cells[cell_rows, cell_columns] @ columns[:, cell_columns].T
        mask[v0:v1, u0:u1] = upsampled > 0  # sigmoid above one half
    return masks


@cache
@torch.inference_mode(False)  # the cached matrix can later be used where gradients are required
def _upsampling_matrix(cells: int, pixels: int) -> Tensor:
    """Linear interpolation from cells to pixels of the same extent, as a matrix, shape (pixels, cells)."""
    return functional.interpolate(torch.eye(cells)[None], pixels, mode="linear")[0].T


def _cell_range(first: int, last: int, upsampling: Tensor) -> slice:
    """Cells from which the pixels first, ..., last - 1 are interpolated, with a margin of one cell on each side."""
    pixels, cells = upsampling.shape
    return slice(max(first * cells // pixels - 1, 0), last * cells // pixels + 2)


def _edges(boxes: Tensor) -> Tensor:
    """Left, top, right and bottom edges of boxes given by centre and size, shape (N, 4)."""
    centre, size = boxes[:, :2], boxes[:, 2:]
    return torch.cat([centre - size / 2, centre + size / 2], dim=1)
