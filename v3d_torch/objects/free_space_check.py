"""Free-space check: points that appeared in free space, and places that objects have vacated.

The paper's votes and Chamfer distances compare centroids and clouds. Both also change when an object is cut by the
image border, occluded, or segmented differently. The camera motion over the static background is known from hundreds
of points and gives an independent test: a point of a static object is observed again at its position, or is hidden. If
the camera measures a depth behind the position, the point has left. If an earlier view measured a depth behind the
position, the point has appeared.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import FreeSpaceConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.kernels import free_space as kernels
from v3d_torch.kernels.compiler import compiled_by, to_array
from v3d_torch.objects.appeared_pixels import AppearedPixels
from v3d_torch.objects.depth_view import DepthView, SpaceView, StoredView
from v3d_torch.objects.image_scale import coarse_stride
from v3d_torch.objects.stored_views import StoredViews
from v3d_torch.types import MIN_INTERVAL, STAMP_TOLERANCE

_VIEW_MARGIN = 0.2
"""Views are kept for this much longer than the longest time span, seconds: at 5 frames per second, the newest view that
is at least as old as the time span can be one frame interval older."""


def limits(config: FreeSpaceConfig) -> kernels.Limits:
    """Return the range of depths and the tolerances for kernels."""
    return config.min_depth, config.max_depth, config.inverse_depth_tolerance, config.min_tolerance


def _observe_compiled(points: Tensor, view: SpaceView, camera: PinholeCamera, config: FreeSpaceConfig) -> Tensor:
    if points.dtype != torch.float64:
        return NotImplemented
    pose, nearest_depth = to_array(view.T_dw), to_array(view.nearest_depth)
    observer = pose, nearest_depth, camera.intrinsics, camera.bounds, limits(config)
    return torch.from_numpy(kernels.observe_free_space(points.numpy(), *observer))


@compiled_by(_observe_compiled)
def observe_free_space(points: Tensor, view: SpaceView, camera: PinholeCamera, config: FreeSpaceConfig) -> Tensor:
    """Return for each point whether a view of another time observes its place as free.

    Args:
        points: Points, world frame, metres, float64, shape :math:`(P, 3)`.
        view: View of another time.
        camera: Camera of the view.
        config: Tolerances.

    Returns:
        1 if the view measures a depth behind the point, 0 if it measures the depth of the point, NaN if the point is
        hidden, outside the image or without depth; float64, shape :math:`(P,)`.
    """
    # One contiguous row per coordinate: the operations below are faster on it.
    in_camera = (view.T_dw[:3, :3] @ points.T + view.T_dw[:3, 3:]).T
    expected = in_camera[:, 2]
    pixels, inside = camera.project_to_image(in_camera, config.min_depth)
    u, v = pixels.round().to(torch.int64).unbind(dim=1)
    index = torch.where(inside, v * camera.width + u, 0)
    measured = torch.where(inside, view.nearest_depth.flatten().index_select(0, index), 0.0).to(torch.float64)
    tolerance = (config.inverse_depth_tolerance * expected.square()).clamp(min=config.min_tolerance)
    visible = (measured > 0) & (measured > expected - tolerance)
    return torch.where(visible, (measured > expected + tolerance).to(torch.float64), torch.nan)


def _was_free_compiled(
    view: DepthView,
    earlier: Sequence[SpaceView | None],
    rays: Tensor,
    stride: int,
    camera: PinholeCamera,
    config: FreeSpaceConfig,
) -> Tensor:
    depth, T_wd, directions = to_array(view.depth[0]), to_array(invert(view.T_dw)), to_array(rays)
    was_free = np.full((len(earlier), -(-depth.shape[0] // stride), -(-depth.shape[1] // stride)), np.nan)
    for row, previous in zip(was_free, earlier, strict=True):
        if previous is not None:
            pose, nearest_depth = to_array(previous.T_dw), to_array(previous.nearest_depth)
            observer = pose, nearest_depth, camera.intrinsics, camera.bounds, limits(config)
            kernels.was_free(depth, stride, directions, T_wd, *observer, row)
    return torch.from_numpy(was_free)


@compiled_by(_was_free_compiled)
def _was_free(
    view: DepthView,
    earlier: Sequence[SpaceView | None],
    rays: Tensor,
    stride: int,
    camera: PinholeCamera,
    config: FreeSpaceConfig,
) -> Tensor:
    """Check whether the points of every n-th pixel lie in space that earlier views observed as free.

    Args:
        view: Current view.
        earlier: Earlier view of each of B time spans; None if there is none.
        rays: Ray of every n-th pixel at unit depth, float64, shape (3, h * w).
        stride: Step n between the pixels.
        camera: Camera of all views.
        config: Range of depths and tolerances.

    Returns:
        1 if the space was free, 0 if it was occupied, NaN if unknown; float64, shape (B, h, w).
    """
    z = view.depth[0, ::stride, ::stride].to(torch.float64)
    was_free = torch.full((len(earlier), *z.shape), torch.nan, dtype=torch.float64)
    measured = torch.nonzero(((z > config.min_depth) & (z <= config.max_depth)).flatten())[:, 0]
    T_wd = invert(view.T_dw)
    in_camera = rays.index_select(1, measured) * z.flatten().index_select(0, measured)
    points = (T_wd[:3, :3] @ in_camera + T_wd[:3, 3:]).T
    for row, previous in zip(was_free.flatten(1), earlier, strict=True):
        if previous is not None:
            row[measured] = observe_free_space(points, previous, camera, config)
    return was_free


def vacated_fractions(
    clouds: Sequence[Tensor], view: SpaceView, camera: PinholeCamera, config: FreeSpaceConfig
) -> Tensor:
    """Fraction of each cloud's visible points whose position is free space in a view of another time.

    Args:
        clouds: Point clouds of K objects, world frame, metres, each of shape :math:`(P_k, 3)`.
        view: View of another time.
        camera: Camera of the view.
        config: Tolerances.

    Returns:
        Fraction from 0 (all points are still there) to 1 (all points have left), NaN if too few points are visible;
        float64, shape :math:`(K,)`.
    """
    if not clouds:
        return torch.zeros(0, dtype=torch.float64)
    points = torch.cat(list(clouds)).to(torch.float64)
    free = observe_free_space(points, view, camera, config).numpy()
    # NumPy counts faster here than torch.
    owner = np.arange(len(clouds)).repeat([len(cloud) for cloud in clouds])
    known = np.bincount(owner, ~np.isnan(free), len(clouds))
    vacated = np.bincount(owner, free == 1, len(clouds))
    return torch.from_numpy(np.where(known >= max(config.min_points, 1), vacated / np.maximum(known, 1), np.nan))


class FreeSpaceCheck(StoredViews):
    """Comparison of each view with earlier views: pixels that appeared in free space.

    Args:
        config: Time spans and tolerances.
        camera: Camera of all views.
    """

    def __init__(self, config: FreeSpaceConfig, camera: PinholeCamera) -> None:
        super().__init__()
        self._config = config
        self._camera = camera
        self._stride = coarse_stride(camera)
        self._rays = camera.rays[:: self._stride, :: self._stride].reshape(-1, 3).T.to(torch.float64)

    def make_view(self, stamp: float, depth: Tensor, T_dw: Tensor, *, is_motion_measured: bool = True) -> DepthView:
        """Make a view. Its misalignment follows from the camera's rotation rate since the last stored view.

        Args:
            stamp: Timestamp, seconds.
            depth: Depth, metres, shape :math:`(1, H, W)`; 0 = no measurement.
            T_dw: World-to-camera pose at the time of the depth image, float64, shape :math:`(4, 4)`.
            is_motion_measured: True if the motion of the camera since the previous frame is measured.
        """
        if not self._views:
            return DepthView(stamp, depth, T_dw, is_motion_measured=is_motion_measured)
        last = self._views[-1]
        angle = float(np.linalg.norm(cv2.Rodrigues((T_dw @ invert(last.T_dw))[:3, :3].numpy())[0]))
        rotation_rate = angle / max(stamp - last.stamp, MIN_INTERVAL)
        misalignment = round(self._camera.fx * rotation_rate * self._config.depth_sync_error)
        return DepthView(stamp, depth, T_dw, misalignment, is_motion_measured)

    def __call__(self, view: DepthView, *, pose_known: bool = True) -> AppearedPixels:
        """Compare a view with the stored views.

        Args:
            view: Current view.
            pose_known: True if the pose of the view relative to the stored views is known. With a guessed pose
                everything would seem to appear; then nothing is compared.

        Returns:
            Pixels that appeared, one row per time span; no row if nothing is compared.
        """
        config = self._config
        time_spans = config.time_spans if config.enabled and pose_known else ()
        earlier = [self._newest_view_before(view.stamp - time_span) for time_span in time_spans]
        was_free = _was_free(view, earlier, self._rays, self._stride, self._camera, config)
        return AppearedPixels(was_free, self._stride)

    def add_view(self, view: DepthView, T_dw: Tensor) -> None:
        """Store a view with its final pose, and drop the views that are too old for all time spans.

        Nothing is stored if the check is turned off.

        Args:
            view: View, newer than all stored ones.
            T_dw: World-to-camera pose at the time of the depth image, float64, shape :math:`(4, 4)`.
        """
        if not self._config.enabled:
            return
        max_age = max(self._config.time_spans, default=0.0) + _VIEW_MARGIN
        self._store(StoredView(view.stamp, view.nearest_depth, T_dw), max_age)

    def _newest_view_before(self, stamp: float) -> StoredView | None:
        return next((view for view in reversed(self._views) if view.stamp <= stamp + STAMP_TOLERANCE), None)
