"""Corpus of damaged inputs, and the expected end of a run for each of them."""

from __future__ import annotations

from helpers.corpus import (
    archives,
    camera_formats,
    cameras,
    configs,
    images,
    layouts,
    lists,
    maps,
    names,
    outputs,
    recordings,
    segmenters,
    truths,
    videos,
    views,
)

CATEGORIES = {
    "lists of images": lists.CASES,
    "image files": images.CASES,
    "image content": views.CASES,
    "ground truth": truths.CASES,
    "cameras": cameras.CASES,
    "camera formats, lenses and depth scales": camera_formats.CASES,
    "configurations": configs.CASES,
    "masks and weights": segmenters.CASES,
    "bags": recordings.CASES,
    "videos": videos.CASES,
    "folders of other datasets": layouts.CASES,
    "sequence names": names.CASES,
    "archives": archives.CASES,
    "maps of earlier runs": maps.CASES,
    "results and permissions": outputs.CASES,
}
