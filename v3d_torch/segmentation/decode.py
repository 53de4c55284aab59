"""Decoding of the raw network output into instances: threshold, suppression, masks from prototypes."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from v3d_torch.geometry.precision import without_autocast
from v3d_torch.kernels import mask_upsampling as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.segmentation.coco import LIVING
from v3d_torch.segmentation.inference import NetworkOutput
from v3d_torch.segmentation.letterbox import CELL, Window
from v3d_torch.segmentation.suppression import non_maximum_suppression
from v3d_torch.types import Instances

_MAX_CANDIDATES = 1024
"""Maximum number of predictions that enter suppression. It bounds the N x N matrix of overlaps, and is far above the
number of predictions that pass a useful score threshold."""


def decode(
    output: NetworkOutput,
    window: Window,
    *,
    score_threshold: float,
    iou_threshold: float | None,
    max_instances: int,
) -> Instances:
    """Decode the output of the network for one image.

    Args:
        output: Output of the network.
        window: Position of the image on the canvas.
        score_threshold: Minimum class score.
        iou_threshold: Intersection over union above which two boxes of one class are the same instance; None disables
            suppression, for one-to-one heads.
        max_instances: Maximum number of instances. People and animals are kept first, because who is missed is not
            masked; then those with the best scores.

    Returns:
        Instances in the image, best score first, each with at least one pixel.
    """
    scores = output.scores.amax(dim=0)
    candidates = torch.nonzero(scores >= score_threshold)[:, 0]
    if len(candidates) == 0:
        return Instances.empty(window.image_height, window.image_width)
    order = candidates[scores[candidates].argsort(descending=True, stable=True)[:_MAX_CANDIDATES]]
    centres_and_sizes, coefficients = output.detections(order)
    boxes, labels, scores = _edges(centres_and_sizes.T), output.scores[:, order].argmax(dim=0), scores[order]
    if iou_threshold is not None:
        keep = non_maximum_suppression(boxes, labels, iou_threshold)
        boxes, labels, scores, coefficients = boxes[keep], labels[keep], scores[keep], coefficients[:, keep]
    if len(boxes) > max_instances:
        keep = _most_important(labels, max_instances)
        boxes, labels, scores, coefficients = boxes[keep], labels[keep], scores[keep], coefficients[:, keep]
    boxes = window.to_image(boxes)

    rows, columns = _needed_prototypes(boxes, window)
    prototypes = output.prototypes(rows, columns)
    masks = assemble_masks(coefficients.T, prototypes, boxes, window, first=(rows.start, columns.start))
    not_empty = masks.view(torch.uint8).flatten(1).amax(dim=1).bool()
    return Instances(masks=masks, labels=labels, scores=scores, boxes=boxes)[not_empty]


def _most_important(labels: Tensor, count: int) -> Tensor:
    """Return the indices of people and animals first, then of the best scores; in the order of the scores."""
    is_thing = ~torch.isin(labels, torch.tensor(sorted(LIVING)))
    return is_thing.to(torch.uint8).argsort(stable=True)[:count].sort().values


def _assemble_masks_compiled(
    coefficients: Tensor, prototypes: Tensor, boxes: Tensor, window: Window, *, first: tuple[int, int] = (0, 0)
) -> Tensor:
    if coefficients.dtype != torch.float32 or prototypes.dtype != torch.float32:
        return NotImplemented
    size = (window.image_height, window.image_width)
    if min(window.height, window.width) < 2 * CELL:
        return NotImplemented
    row_cells, row_weights = _interpolation(window.height // CELL, size[0])
    column_cells, column_weights = _interpolation(window.width // CELL, size[1])
    logits = (coefficients @ prototypes.flatten(1)).unflatten(1, prototypes.shape[1:])
    masks = torch.zeros(len(boxes), *size, dtype=torch.bool)
    kernels.upsample_masks(
        to_array(logits),
        to_array(boxes.ceil().long()),
        (first[0] - window.top // CELL, first[1] - window.left // CELL),
        row_cells,
        row_weights,
        np.searchsorted(column_cells, np.arange(window.width // CELL)),
        column_weights,
        masks.numpy(),
    )
    return masks


@without_autocast
@compiled_by(_assemble_masks_compiled)
def assemble_masks(
    coefficients: Tensor, prototypes: Tensor, boxes: Tensor, window: Window, *, first: tuple[int, int] = (0, 0)
) -> Tensor:
    """Masks as linear combinations of prototypes, upsampled to the image and cropped to their boxes.

    Source: YOLACT (Bolya et al., ICCV 2019), Sec. 3.1.

    Args:
        coefficients: Prototype coefficients of each instance, shape :math:`(N, P)`.
        prototypes: Mask prototypes, of the whole canvas or of a section that covers the boxes, shape :math:`(P, h, w)`.
        boxes: Left, top, right and bottom edges, image pixels, shape :math:`(N, 4)`.
        window: Position of the image on the canvas.
        first: Row and column of the section's first cell among the prototypes of the canvas.

    Returns:
        Instance masks, bool, shape :math:`(N, H, W)`.
    """
    # Upsampling is linear and separable: mask = R L C with R (H x h) and C (w x W). A box needs only a block of each.
    upsample_rows = _upsampling_matrix(window.height // CELL, window.image_height)
    upsample_columns = _upsampling_matrix(window.width // CELL, window.image_width)
    top, left = window.top // CELL - first[0], window.left // CELL - first[1]  # of the image, cells
    logits = (coefficients @ prototypes.flatten(1)).unflatten(1, prototypes.shape[1:])

    masks = torch.zeros(len(boxes), window.image_height, window.image_width, dtype=torch.bool)
    for mask, cells, (u0, v0, u1, v1) in zip(masks, logits, _inside(boxes), strict=True):
        rows, columns = _cell_range(v0, v1, upsample_rows), _cell_range(u0, u1, upsample_columns)
        block = cells[top + rows.start : top + rows.stop, left + columns.start : left + columns.stop]
        upsampled = upsample_rows[v0:v1, rows] @ block @ upsample_columns[u0:u1, columns].T
        mask[v0:v1, u0:u1] = upsampled > 0  # sigmoid above one half
    return masks


def _needed_prototypes(boxes: Tensor, window: Window) -> tuple[slice, slice]:
    """Rows and columns of the prototypes that cover all boxes, cells of the canvas."""
    inside = _inside(boxes)
    upsample_rows = _upsampling_matrix(window.height // CELL, window.image_height)
    upsample_columns = _upsampling_matrix(window.width // CELL, window.image_width)
    rows = [_cell_range(v0, v1, upsample_rows) for _, v0, _, v1 in inside]
    columns = [_cell_range(u0, u1, upsample_columns) for u0, _, u1, _ in inside]
    top, left = window.top // CELL, window.left // CELL
    return (
        slice(top + min(cells.start for cells in rows), top + max(cells.stop for cells in rows)),
        slice(left + min(cells.start for cells in columns), left + max(cells.stop for cells in columns)),
    )


def _inside(boxes: Tensor) -> list[list[int]]:
    """First and last pixels inside boxes, (u0, v0, u1, v1): pixel u is inside if left <= u < right."""
    pixels: list[list[int]] = boxes.ceil().long().tolist()
    return pixels


@cache
@torch.inference_mode(False)  # the cached matrix can later be used where gradients are required
def _upsampling_matrix(cells: int, pixels: int) -> Tensor:
    """Linear interpolation from cells to pixels of the same extent, as a matrix, shape (pixels, cells)."""
    return functional.interpolate(torch.eye(cells, dtype=torch.float32)[None], pixels, mode="linear")[0].T


@cache
def _interpolation(cells: int, pixels: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Non-zero elements of `_upsampling_matrix`: first of two cells, shape (pixels,), and weights, (pixels, 2)."""
    upsampling = _upsampling_matrix(cells, pixels).numpy()
    first = np.minimum((upsampling > 0).argmax(axis=1), cells - 2)
    return first, np.take_along_axis(upsampling, np.stack([first, first + 1], axis=1), axis=1)


def _cell_range(first: int, last: int, upsampling: Tensor) -> slice:
    """Cells from which the pixels first, ..., last - 1 are interpolated, with a margin of one cell on each side."""
    pixels, cells = upsampling.shape
    return slice(max(first * cells // pixels - 1, 0), min(last * cells // pixels + 2, cells))


def _edges(boxes: Tensor) -> Tensor:
    """Left, top, right and bottom edges of boxes given by centre and size, shape (N, 4)."""
    centre, size = boxes[:, :2], boxes[:, 2:]
    return torch.cat([centre - size / 2, centre + size / 2], dim=1)
