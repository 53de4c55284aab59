"""Live processing: capture, preprocessing and tracking in parallel, each on the newest frame."""

from __future__ import annotations

from v3d_torch.live.live_slam import LiveResult, LiveSLAM

__all__ = ["LiveResult", "LiveSLAM"]
