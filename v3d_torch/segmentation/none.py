"""The baseline: nothing is ever segmented."""

from __future__ import annotations

from v3d_torch.types import Instances, RGBDFrame


class NoSegmentation:
    """Sees no instances in any frame."""

    def __call__(self, frame: RGBDFrame) -> Instances:
        """No instances, at the frame's size."""
        return Instances.empty(*frame.image.shape[1:])
