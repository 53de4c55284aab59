"""Files of the segmenter of a run: what counts as a change."""

from __future__ import annotations

from pathlib import Path

from v3d_torch.runs.segmentation_files import SegmentationFiles
from v3d_torch.segmentation import NoSegmentation


def test_change_of_the_weights_is_seen_although_the_size_is_the_same(tmp_path: Path) -> None:
    weights, other = tmp_path / "network.onnx", tmp_path / "moved.onnx"
    weights.write_bytes(b"123")
    other.write_bytes(b"123")
    stored = SegmentationFiles(str(weights), NoSegmentation(), iter(())).fingerprint(3)  # type: ignore[arg-type]
    assert SegmentationFiles(str(other), NoSegmentation(), iter(())).changed_file(stored) is None  # type: ignore[arg-type]
    weights.write_bytes(b"124")
    files = SegmentationFiles(str(weights), NoSegmentation(), iter(()))  # type: ignore[arg-type]
    assert files.changed_file(stored) == weights
