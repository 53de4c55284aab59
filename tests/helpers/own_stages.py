"""A package with stages of a user's own, written to a folder as a user would have it."""

from __future__ import annotations

from pathlib import Path

MODULE = "lab_stages"
"""Name of the module."""

SEGMENT = f"stages.segment={MODULE}:Corner"
"""Override that selects its segmenter."""

TEXT = '''
"""Stages for tests."""

import torch

from v3d_torch import Instances
from v3d_torch.geometry.depth_smoother import DepthSmoother


class Corner:
    """Segmenter that finds a person in the upper left corner of every image."""

    def __init__(self, config, camera):
        self.size = camera.height, camera.width
        self.threshold = config.segmentation.score_threshold

    def __call__(self, frame):
        masks = torch.zeros(1, *self.size, dtype=torch.bool)
        masks[..., :8, :8] = True
        return Instances(masks, torch.zeros(1, dtype=torch.int64), torch.ones(1), torch.zeros(1, 4))


class Outer:
    class Same(DepthSmoother):
        def __init__(self, config, camera):
            super().__init__(config.depth.kernel_size, config.depth.sigma, config.depth.edge_ratio)


class Network(torch.nn.Module):
    def __init__(self, config, camera):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.ones(()))

    def forward(self, depth):
        return self.scale * depth


def flat(config, camera):
    return lambda depth: depth[0]


def one_argument(config):
    raise AssertionError


def nothing(config, camera):
    return None


number = 3
'''


def write_own_stages(folder: Path) -> Path:
    """Write the module to a folder, which then has to be on the path of imports; return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{MODULE}.py").write_text(TEXT)
    return folder
