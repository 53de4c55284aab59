"""The background's word on an object: whether the places where its points were are still filled.

The paper's votes and Chamfer distances compare centroids and clouds, and both change when an object is cut by the image
border, covered by another one, or segmented differently. The camera's motion over the background, known from hundreds
of points, gives a test that does not: a point of a still object is seen again where it was, or is hidden. Where the
camera looks through the place, the point has gone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import BackgroundConfig


@dataclass(frozen=True)
class DepthView:
    """What a depth image says of the world.

    Attributes:
        depth: metres, float32, shape :math:`(1, H, W)`; 0 = no measurement.
        T_cw: world to camera, float64, shape :math:`(4, 4)`.
    """

    depth: Tensor
    T_cw: Tensor


def vacated_share(cloud: Tensor, view: DepthView, camera: PinholeCamera, config: BackgroundConfig) -> float:
    """Share of a cloud's points, of those in sight, whose place another view looks through.

    Args:
        cloud: world frame, metres, float32, shape :math:`(P, 3)`.
        view: of another time.
        camera: of the view.
        config: tolerances.

    Returns:
        Between 0 (all are still there) and 1 (all have gone); nan when too few are in sight to tell.
    """
    points = cloud.to(torch.float64) @ view.T_cw[:3, :3].T + view.T_cw[:3, 3]
    points = points[points[:, 2] > config.min_depth]
    u, v = camera.distort(camera.project(points)).round().to(torch.int64).unbind(dim=1)
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    expected = points[inside, 2]
    measured = view.depth[0, v[inside], u[inside]].to(torch.float64)
    tolerance = (config.tolerance * expected.square()).clamp(min=config.min_tolerance)
    in_sight = (measured > 0) & (measured > expected - tolerance)
    if int(in_sight.sum()) < config.min_points:
        return torch.nan
    return float((measured[in_sight] > (expected + tolerance)[in_sight]).double().mean())


def moved_share(
    then: tuple[Tensor, DepthView], now: tuple[Tensor, DepthView], camera: PinholeCamera, config: BackgroundConfig
) -> float:
    """Share of an object that moved between two times: left its places, or came to places that were empty.

    Args:
        then: cloud in the world, and the view that saw it.
        now: the same of the later time.
        camera: of both views.
        config: tolerances.

    Returns:
        The greater of both shares; nan when neither can be told.
    """
    left = vacated_share(then[0], now[1], camera, config)
    came = vacated_share(now[0], then[1], camera, config)
    known = [share for share in (left, came) if share == share]  # nan is not equal to itself
    return max(known, default=torch.nan)
