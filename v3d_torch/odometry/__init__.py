"""Odometry: camera motion between two frames, rolling shutter, depth delay (paper, Sec. III-E)."""
