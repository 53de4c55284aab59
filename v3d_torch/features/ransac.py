"""RANSAC: the epipolar constraint between two images, and the pose from points with depth (paper, Sec. III-E)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import kornia_rs
import torch
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import rigid
from v3d_torch.optim.pose_refinement import refine_pose
from v3d_torch.optim.reprojection import INLIER_LIMIT, Measurements

_SOME = 100
"""Points that RANSAC looks at first, evenly taken from all: kornia-rs takes 30 microseconds for each. Where no pose
explains half of all points, so few are too few to find the one that explains a fifth."""


def epipolar_inliers(uv_a: Tensor, uv_b: Tensor, *, threshold: float, iterations: int, seed: int) -> Tensor:
    """Pairs that one fundamental matrix explains.

    Args:
        uv_a: undistorted pixels in the first image, float64, shape :math:`(N, 2)`.
        uv_b: undistorted pixels in the second image, float64, shape :math:`(N, 2)`.
        threshold: Sampson distance, pixels.
        iterations: most hypotheses.
        seed: of the sampling.

    Returns:
        bool, shape :math:`(N,)`; all false when there are fewer than 8 pairs or no matrix is found.
    """
    none = torch.zeros(uv_a.shape[0], dtype=torch.bool)
    if uv_a.shape[0] < 8:
        return none
    pairs = torch.cat([uv_a, uv_b], dim=1).contiguous().numpy()
    try:
        found = kornia_rs.ransac.fundamental(pairs, threshold=threshold, max_iters=iterations, seed=seed)
    except ValueError:  # kornia-rs's way to say that no sample gave a model
        return none
    return torch.tensor(found.inliers, dtype=torch.bool)


def pnp_ransac(
    points: Tensor,
    uv: Tensor,
    camera: PinholeCamera,
    *,
    threshold: float,
    iterations: int,
    seed: int,
    guess: Tensor | None = None,
) -> tuple[Tensor, Tensor] | None:
    """Pose of a camera that sees known points: EPnP in RANSAC, refined on all that agree.

    Args:
        points: metres, float64, shape :math:`(N, 3)`, in some frame "w".
        uv: undistorted pixels, float64, shape :math:`(N, 2)`.
        camera: that sees them.
        threshold: reprojection error of an inlier, pixels.
        iterations: most hypotheses.
        seed: of the sampling.
        guess: a pose that may be near, float64, shape :math:`(4, 4)`: if it, refined, explains half of the points,
            nothing is sampled.

    Returns:
        ``T_cw``, float64, shape :math:`(4, 4)`, and the inliers, bool, shape :math:`(N,)`; None without a solution.
    """
    count = points.shape[0]
    if count < 6:
        return None
    sigma = uv.new_full((count,), threshold / math.sqrt(INLIER_LIMIT))
    # Without the camera's own depth: the points' depths have told what they can.
    seen = Measurements(uv=uv, inverse_depth=uv.new_zeros(count), pixel_sigma=sigma, inverse_depth_sigma=1.0)

    def starts() -> Iterator[Tensor]:
        if guess is not None:
            yield guess
        for enough in sorted({min(_SOME, count), count}):
            some = torch.linspace(0, count - 1, enough).round().to(torch.int64)
            T_cw = _sampled(points[some], uv[some], camera.K, threshold=threshold, iterations=iterations, seed=seed)
            if T_cw is not None:
                yield T_cw

    found = None
    for T_cw in starts():
        refined = refine_pose(T_cw, points, seen, camera, rounds=2)
        found = refined.T_cw, refined.inliers
        if 2 * int(refined.inliers.sum()) > count:
            break
    return found


def _sampled(points: Tensor, uv: Tensor, K: Tensor, *, threshold: float, iterations: int, seed: int) -> Tensor | None:
    try:
        R, t, _, _ = kornia_rs.k3d.solve_pnp_ransac(
            points.numpy(),
            uv.numpy(),
            K.numpy(),
            threshold=threshold,
            max_iterations=iterations,
            lo_every=5,
            seed=seed,
        )
    except ValueError:  # kornia-rs's way to say that no sample gave a pose
        return None
    T_cw = torch.eye(4, dtype=torch.float64)
    T_cw[:3, :3] = torch.from_numpy(R)
    T_cw[:3, 3] = torch.from_numpy(t).reshape(3)
    return rigid(T_cw) if bool(torch.isfinite(T_cw).all()) else None
