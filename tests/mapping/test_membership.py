"""Membership by a lookup table."""

from __future__ import annotations

import numpy as np

from v3d_torch.mapping.membership import contains


def test_contains_equals_isin_and_is_false_for_minus_one() -> None:
    generator = np.random.default_rng(0)
    queries = generator.integers(-1, 50, 200)
    for count in (0, 1, 30):
        ids = generator.integers(-1, 50, count)
        assert np.array_equal(contains(ids, queries, 50), np.isin(queries, ids) & (queries >= 0))
