"""Assignment of instances to tracks by overlap, distance and class."""

from __future__ import annotations

import torch

from v3d_torch.objects.assignment import match_instances


def test_class_change_cost_decides_between_similar_overlaps() -> None:
    """Track 0 overlaps instance 1 slightly more, but instance 1 has the class of track 1."""
    unknown = torch.full((1, 2, 3), torch.nan)
    overlap = torch.tensor([[[0.6, 0.7], [0.7, 0.6]]], dtype=torch.float64)
    gate = torch.ones(1, 2, dtype=torch.float64)
    same_class = torch.eye(2, dtype=torch.bool)[None]
    assert match_instances(unknown, unknown, overlap, same_class, gate, 0.5).tolist() == [[0, 1]]
    assert match_instances(unknown, unknown, overlap, same_class | True, gate, 0.5).tolist() == [[1, 0]]


def test_distance_cost_is_limited_to_one_gate() -> None:
    """Masks in position with centroids five gates away, against a swap that saves less than one gate in total."""
    predicted = torch.tensor([[[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]], dtype=torch.float64)
    observed = torch.tensor([[[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]]], dtype=torch.float64)
    gate = torch.ones(1, 2, dtype=torch.float64)
    everything = torch.ones(1, 2, 2, dtype=torch.bool)
    overlap = torch.eye(2, dtype=torch.float64)[None] * 0.9
    matched = match_instances(predicted, observed, overlap, ~everything, gate, 0.5)
    assert matched.tolist() == [[0, 1]]
