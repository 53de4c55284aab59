"""The object stage: clean clouds, ids, who moves (paper, Sec. III-B, C, D)."""
