"""Files from which a run segments its frames. With others, the results of a resumed run would mix two segmentations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from v3d_torch.datasets import RGBDSequence, RGBDStream
from v3d_torch.io.files import file_size
from v3d_torch.segmentation import MaskFolder
from v3d_torch.segmentation.weights import sha256_of
from v3d_torch.types import Segmenter


class SegmentationFiles:
    """Weights or id images of a run. The checksum of the weights is computed on construction.

    Args:
        weights: Weights file given by the user; None for the published weights.
        segment: Segmenter of the run.
        sequence: Frames of the run; only an `RGBDSequence` has known id images.

    Raises:
        WeightsError: If the weights cannot be read.
    """

    def __init__(self, weights: str | None, segment: Segmenter, sequence: RGBDStream) -> None:
        self._weights = weights
        self._checksum = None if weights is None else sha256_of(Path(weights))
        self._masks = segment if isinstance(segment, MaskFolder) else None
        self._sequence = sequence
        self._sizes: list[list[str | int | None] | None] = []

    def fingerprint(self, frames: int) -> dict[str, Any]:
        """Return plain values that distinguish the files of the first frames from others.

        The size of each id image is read once, because runs can have 100,000 frames on a network drive.
        """
        labels = None if self._masks is None else self._masks.labels
        return {
            "weights": self._checksum,
            "labels": None if labels is None else [list(label) for label in sorted(labels.items())],
            "masks": self._mask_sizes(frames),
        }

    def changed_file(self, fingerprint: Mapping[str, Any]) -> Path | None:
        """Return the first file that has changed since `fingerprint` returned a value; None if there is none."""
        stored = fingerprint["masks"]
        current = self.fingerprint(len(stored))
        if self._weights is not None and fingerprint["weights"] != current["weights"]:
            return Path(self._weights)
        if self._masks is None:
            return None
        for before, now in zip(stored, current["masks"], strict=False):
            if before != now:
                return self._masks.folder / (now or before)[0]
        labels = current["labels"]
        return self._masks.labels_path if fingerprint["labels"] != labels else None

    def _mask_sizes(self, frames: int) -> list[list[str | int | None] | None]:
        """Return name and size in bytes of the id image of each of the first frames; None for a frame without one."""
        if self._masks is None or not isinstance(self._sequence, RGBDSequence):
            return []
        for index in range(len(self._sizes), min(frames, len(self._sequence))):
            path = self._masks.find_path(index, float(self._sequence.stamps[index]))
            self._sizes.append(None if path is None else [path.name, file_size(path)])
        return self._sizes[:frames]
