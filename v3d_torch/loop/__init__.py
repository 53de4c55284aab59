"""Loop closing: places, pose graph (paper, Sec. III-E)."""
