"""Assertions on folders of sequences that are damaged."""

from __future__ import annotations

from pathlib import Path

import pytest

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import GroundTruthWarning, InputError


def assert_rejected(folder: Path, message: str) -> None:
    """Check that a folder cannot be loaded; the error is one line with the folder that matches the message."""
    with pytest.raises(InputError, match=message) as caught:
        load_sequence(str(folder))
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def assert_ground_truth_is_left_out(folder: Path, file: Path, message: str) -> None:
    """Check that a folder is loaded with a warning and without ground truth, because a file is damaged."""
    with pytest.warns(GroundTruthWarning):
        sequence = load_sequence(str(folder))
    assert isinstance(sequence, StoredSequence) and sequence.groundtruth is None
    assert str(sequence.groundtruth_error).startswith(f"{file}: {message}")
