"""The camera stage: features, matching, RANSAC, pose (paper, Sec. III-E)."""
