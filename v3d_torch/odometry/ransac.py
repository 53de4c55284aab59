"""RANSAC: the epipolar constraint between two images, and the pose from points with depth (paper, Sec. III-E)."""

from __future__ import annotations

import kornia_rs
import torch
from torch import Tensor

from v3d_torch.lie import rigid


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
    points: Tensor, uv: Tensor, K: Tensor, *, threshold: float, iterations: int, seed: int
) -> tuple[Tensor, Tensor] | None:
    """Pose of a camera that sees known points (EPnP in RANSAC with local optimisation).

    Args:
        points: metres, float64, shape :math:`(N, 3)`, in some frame "w".
        uv: undistorted pixels, float64, shape :math:`(N, 2)`.
        K: camera matrix, float64, shape :math:`(3, 3)`.
        threshold: reprojection error of an inlier, pixels.
        iterations: most hypotheses.
        seed: of the sampling.

    Returns:
        ``T_cw``, float64, shape :math:`(4, 4)`, and the inliers, bool, shape :math:`(N,)`; None without a solution.
    """
    if points.shape[0] < 6:
        return None
    try:
        R, t, inliers, _ = kornia_rs.k3d.solve_pnp_ransac(
            points.contiguous().numpy(),
            uv.contiguous().numpy(),
            K.contiguous().numpy(),
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
    if not torch.isfinite(T_cw).all():
        return None
    return rigid(T_cw), torch.from_numpy(inliers.astype(bool))
