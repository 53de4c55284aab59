"""Stamps of the images of a topic."""

from __future__ import annotations

from pathlib import Path

import pytest

from v3d_torch.datasets.ros.bag_stamps import index_by_stamp


@pytest.mark.parametrize("stamp", [0.0, 1000.0])
def test_times_of_arrival_replace_stamps_that_are_all_equal(stamp: float) -> None:
    indices, note = index_by_stamp(Path("a.bag"), "/rgb", [stamp] * 3, [5.0, 5.1, 5.2])
    assert indices == {5.0: 0, 5.1: 1, 5.2: 2}
    assert (note is None) is (stamp == 0)
    assert note is None or note.endswith("all images have the stamp 1000.000000 s; their times of arrival are used")


def test_single_image_keeps_its_stamp_or_arrival() -> None:
    assert index_by_stamp(Path("a.bag"), "/rgb", [0.0], [5.0]) == ({5.0: 0}, None)
