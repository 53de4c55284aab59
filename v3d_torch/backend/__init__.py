"""Background optimisation: local bundle adjustment, loop closing, pose graph (paper, Sec. III-E)."""
