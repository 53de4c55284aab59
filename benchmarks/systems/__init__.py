"""Systems that run on the same frames, each in its own process: this package, and others from PyPI."""

OURS = ("v3d_torch", "v3d_torch --config realtime", "v3d_torch --serial", "v3d_torch --segmenter none")
PEERS = ("pyorbslam3", "open3d")
