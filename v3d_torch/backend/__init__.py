"""Background optimisation of the map: local bundle adjustment, loop closing, pose graph (paper, Sec. III-E)."""
