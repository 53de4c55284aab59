"""Objects of a frame: clean clouds, ids, motion states and the static mask (paper, Sec. III-B to III-D)."""
