"""Broken sequences, and how a run of each has to end."""

from __future__ import annotations

from helpers.corpus import (
    archives,
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
    "what the images show": views.CASES,
    "ground truth": truths.CASES,
    "cameras": cameras.CASES,
    "configurations": configs.CASES,
    "masks and weights": segmenters.CASES,
    "bags": recordings.CASES,
    "videos": videos.CASES,
    "folders of other datasets": layouts.CASES,
    "what --seq names": names.CASES,
    "archives": archives.CASES,
    "maps of earlier runs": maps.CASES,
    "results and rights": outputs.CASES,
}
