"""Tracking of the camera against the map, and the history of its poses (paper, Sec. III-E)."""
