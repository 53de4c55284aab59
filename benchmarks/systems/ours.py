"""System with this package: the same as ``python -m v3d_torch.run``, without writing results."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import torch

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.kernels.compiler import compile_kernels
from v3d_torch.pipeline import FrameCallback, Pipeline
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation import make_segmenter
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Trajectory

OPTIONS = {
    "v3d_torch": ("full", []),
    "v3d_torch --config realtime": ("realtime", []),
    "v3d_torch --serial": ("full", ["prefetch=false"]),  # as in v3d_torch/cli/run.py
    "v3d_torch --segmenter none": ("full", ["segmentation.source=none"]),
}
"""Configuration and overrides of each system."""


class Ours:
    """System with this package.

    Args:
        sequence: Sequence to run on.
        name: Key of `OPTIONS`.
        seed: Seed of all random choices.

    Attributes:
        slam: System.
        pipeline: Pipeline that runs the system.
    """

    def __init__(self, sequence: RGBDSequence, name: str, seed: int) -> None:
        configuration, overrides = OPTIONS[name]
        config = load_config(configuration, [f"seed={seed}", *overrides])
        set_num_threads(config.threads)
        torch.manual_seed(seed)
        self.slam = V3DSLAM(sequence.camera, make_segmenter(config, sequence.camera), config)
        self.pipeline = Pipeline(sequence, self.slam, evaluate_masks=False)  # not part of tracking
        deque(compile_kernels(), maxlen=0)

    @property
    def stages(self) -> Mapping[str, float]:
        """Seconds by stage. The times of stages that run in parallel overlap."""
        return self.slam.timer.seconds

    def __call__(self, on_frame: FrameCallback | None = None) -> None:
        """Track all frames, and apply the last correction of the map to their poses.

        The dense map is not fused: the other systems make none.

        Args:
            on_frame: Called after each frame.

        Raises:
            RuntimeError: If the run ended before the sequence.
        """
        failure = self.pipeline(on_frame).failure
        if failure is not None:
            raise RuntimeError(failure)
        with torch.inference_mode():
            self.slam.flush()

    def trajectory(self) -> Trajectory:
        """Return a pose for every frame."""
        return self.slam.poses.trajectory()
