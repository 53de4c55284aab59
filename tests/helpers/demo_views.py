"""Small renderings of the demo, and the world points of their pixels."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from v3d_torch.datasets.demo.renderer import Renderer, Rendering
from v3d_torch.geometry.camera import PinholeCamera

SMALL = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120, readout=0.0)
"""Camera of the demo at a quarter of its resolution."""


def render_at(renderer: Renderer, time: float) -> Rendering:
    """Render the image that the camera of the scene takes at a time."""
    return renderer(renderer.scene.trajectory.pose(time), time)


def world_points(depth: Tensor, T_wc: np.ndarray, camera: PinholeCamera = SMALL) -> np.ndarray:
    """Back-project a depth image to world points, shape (H, W, 3)."""
    points = (camera.rays * depth[..., None]).double().numpy()
    return points @ T_wc[:3, :3].T + T_wc[:3, 3]
