"""The commands of the package."""

import os

from v3d_torch.io.paths import cache_dir

# matplotlib reads this variable when it is imported. It stores its list of fonts in the folder, and searches it for a
# matplotlibrc, which would change the figures.
os.environ.setdefault("MPLCONFIGDIR", str(cache_dir() / "matplotlib"))
