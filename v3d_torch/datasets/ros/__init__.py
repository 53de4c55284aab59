"""Recordings of ROS: bags of ROS 1 (``.bag``), ROS 2 (``.db3``) and mcap files, read without ROS."""

from __future__ import annotations

from v3d_torch.datasets.ros.bag_sequence import BagSequence, is_bag, read_topic_types

__all__ = ["BagSequence", "is_bag", "read_topic_types"]
