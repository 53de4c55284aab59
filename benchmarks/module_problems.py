"""Benchmark problems of the camera modules, each with its implementations: this package first, then other libraries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import kornia_rs
import module_peers as peers
import numpy as np
import open3d as o3d
import torch
from evo.core.geometry import umeyama_alignment
from kornia.feature import match_smnn
from kornia.geometry import RANSAC
from timing import OURS, Implementations
from torch import Tensor

import v3d_torch as v3d
from v3d_torch.geometry.se3 import hat, invert, se3_exp, se3_log

CAMERA = v3d.PinholeCamera(525.0, 525.0, 319.5, 239.5)
K = CAMERA.K
Error = Callable[[Any], float]


class Problems:
    """Random problems with a fixed seed.

    Args:
        batch: Number of problems, also the seed.
    """

    def __init__(self, batch: int) -> None:
        self.batch = batch
        self.generator = torch.Generator().manual_seed(batch)

    def normal(self, *shape: int) -> Tensor:
        """Normally distributed random numbers, shape (B, *shape)."""
        return torch.randn(self.batch, *shape, generator=self.generator, dtype=torch.float64)

    def uniform(self, *shape: int) -> Tensor:
        """Random numbers in [0, 1), shape (B, *shape)."""
        return torch.rand(self.batch, *shape, generator=self.generator, dtype=torch.float64)

    def points(self, count: int) -> Tensor:
        """Points in the camera frame, one to four metres away."""
        uv = self.uniform(count, 2) * torch.tensor([600.0, 440.0], dtype=torch.float64) + 20
        return CAMERA.back_project(uv, 1 + 3 * self.uniform(count))


def transform(T: Tensor, points: Tensor) -> Tensor:
    """Points moved by rigid motions, (B, N, 3)."""
    return points @ T[..., :3, :3].mT + T[..., None, :3, 3]


def pose_error(true: Tensor) -> Error:
    """Median length of the logarithm between poses and the true ones, in thousandths: millimetres and milliradians."""
    return lambda found: 1e3 * float(se3_log(found @ invert(true)).norm(dim=-1).median())


def matching(batch: int) -> tuple[Implementations, Error]:
    """Matching of 500 descriptors with a permutation of them, 30 of 256 bits different. Error: missed matches, %."""
    problems = Problems(batch)
    a = (256 * problems.uniform(500, 32)).to(torch.uint8)
    order = problems.uniform(500).argsort(dim=1)
    flips = np.packbits(problems.uniform(500, 256).numpy() < 30 / 256, axis=-1)
    b = (a ^ torch.from_numpy(flips)).gather(1, order[..., None].expand_as(a))
    expected = order.argsort(dim=1)
    pairs = list(zip(a.numpy(), b.numpy(), strict=True))
    bits = [torch.from_numpy(np.unpackbits(each.numpy(), axis=-1)).float() for each in (a, b)]
    cross = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)

    def to_rows(matches: list[Any]) -> Tensor:
        rows = torch.full((batch, 500), -1)
        for row, each in zip(rows, matches, strict=True):
            each = torch.as_tensor(each)
            row[each[:, 0]] = each[:, 1]
        return rows

    limits = {"max_distance": 64, "max_ratio": 0.8, "cross_check": True}
    implementations: Implementations = {
        OURS: lambda: v3d.match_descriptors(a, b, max_hamming=64, max_ratio=0.8),
        "kornia-rs": lambda: to_rows([kornia_rs.features.match_descriptors(x, y, **limits) for x, y in pairs]),
        "OpenCV (no ratio)": lambda: to_rows(
            [np.array([(m.queryIdx, m.trainIdx) for m in cross.match(x, y)]) for x, y in pairs]
        ),
        "Kornia (of float bits)": lambda: to_rows([match_smnn(x, y, 0.9)[1] for x, y in zip(*bits, strict=True)]),
    }
    return implementations, lambda found: 100 * float((found != expected).double().mean())


def essential(batch: int) -> tuple[Implementations, Error]:
    """Essential matrix of 500 pairs, 0.5 pixels of noise, 30 % outliers. Error: norm of the difference, thousandths."""
    problems = Problems(batch)
    points = problems.points(500)
    step = torch.tensor([0.3, -0.1, 0.2, 0.05, 0.1, -0.05], dtype=torch.float64)
    T_ba = se3_exp(step + 0.05 * problems.normal(6))
    uv_a, uv_b = CAMERA.project(points), CAMERA.project(transform(T_ba, points)) + 0.5 * problems.normal(500, 2)
    uv_b[:, 350:] += 20 + 80 * problems.uniform(150, 2)
    t = T_ba[:, :3, 3]
    true = hat(torch.cat([torch.zeros_like(t), t], dim=1))[:, :3, :3] @ T_ba[:, :3, :3]
    true = true / true.norm(dim=(1, 2), keepdim=True)
    arrays = list(zip(uv_a.numpy(), uv_b.numpy(), strict=True))
    xy = [(each - K[:2, 2]) / K.diagonal()[:2] for each in (uv_a, uv_b)]
    pairs = torch.cat(xy, dim=2).numpy()
    threshold = 1.5 / CAMERA.fx

    def error(found: Any) -> float:
        E = torch.stack([torch.as_tensor(each, dtype=torch.float64).reshape(-1, 3, 3)[0] for each in found])
        E = E / E.norm(dim=(1, 2), keepdim=True)
        return 1e3 * float(torch.minimum((E - true).norm(dim=(1, 2)), (E + true).norm(dim=(1, 2))).median())

    def kornia_ransac() -> list[Tensor]:
        ransac = RANSAC("essential", inl_th=threshold, max_iter=10, seed=0)
        return [ransac(x, y)[0] for x, y in zip(*xy, strict=True)]

    implementations: Implementations = {
        OURS: lambda: v3d.essential_ransac(uv_a, uv_b, K, threshold=1.5).E,
        "OpenCV": lambda: [cv2.findEssentialMat(x, y, K.numpy(), cv2.RANSAC, 0.999, 1.5)[0] for x, y in arrays],
        "OpenCV (USAC)": lambda: [
            cv2.findEssentialMat(x, y, K.numpy(), K.numpy(), None, None, peers.default_usac_options(1.5))[0]
            for x, y in arrays
        ],
        "kornia-rs (no refinement)": lambda: [
            kornia_rs.ransac.essential(each, threshold=threshold**2, max_iters=300, seed=0).model for each in pairs
        ],
        "Kornia": kornia_ransac,
    }
    return implementations, error


def pnp(batch: int) -> tuple[Implementations, Error]:
    """PnP-RANSAC of 500 points with 1 pixel of noise and 30 % outliers. Error: pose, thousandths."""
    problems = Problems(batch)
    T_cw, in_camera = se3_exp(problems.normal(6)), problems.points(500)
    points, uv = transform(invert(T_cw), in_camera), CAMERA.project(in_camera) + problems.normal(500, 2)
    uv[:, 350:] += 20 + 80 * problems.uniform(150, 2)
    arrays = list(zip(points.numpy(), uv.numpy(), strict=True))

    def from_kornia_rs() -> Tensor:
        T = torch.eye(4, dtype=torch.float64).repeat(batch, 1, 1)
        for k, (X, u) in enumerate(arrays):
            found = kornia_rs.k3d.solve_pnp_ransac(
                X, u, K.numpy(), threshold=4.0, max_iterations=300, lo_every=5, seed=0
            )
            T[k, :3, :3], T[k, :3, 3] = torch.from_numpy(found[0]), torch.from_numpy(found[1])
        return T

    options = {"reprojectionError": 4.0, "confidence": 0.999, "iterationsCount": 300}
    implementations: Implementations = {
        OURS: lambda: v3d.pnp_ransac(points, uv, K, threshold=4.0).T_cw,
        "OpenCV": lambda: peers.to_poses(
            [cv2.solvePnPRansac(X, u, K.numpy(), None, **options)[1:3] for X, u in arrays]
        ),
        "OpenCV (USAC)": lambda: peers.to_poses(
            [cv2.solvePnPRansac(X, u, K.numpy(), None, params=peers.default_usac_options(4.0))[2:4] for X, u in arrays]
        ),
        "kornia-rs": from_kornia_rs,
    }
    return implementations, pose_error(T_cw)


def refinement_problem(problems: Problems) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """True poses, points and their pixels with 1 pixel of noise, and poses near the true ones."""
    T_cw, in_camera = se3_exp(problems.normal(6)), problems.points(100)
    uv = CAMERA.project(in_camera) + problems.normal(100, 2)
    return T_cw, transform(invert(T_cw), in_camera), uv, se3_exp(0.02 * problems.normal(6)) @ T_cw


def refinement(batch: int) -> tuple[Implementations, Error]:
    """Refinement of a pose with 100 points, least squares of pixels. Error: pose, thousandths."""
    problems = Problems(batch)
    T_cw, points, uv, start = refinement_problem(problems)
    unit = torch.ones(batch, 100, dtype=torch.float64)
    by_theseus = peers.theseus_poses(start, points, uv, K, unit)
    implementations: Implementations = {
        OURS: lambda: v3d.refine_pose(start, points, uv, K, pixel_sigma=100.0, rounds=1, iterations=10).T_cw,
        "GTSAM": peers.gtsam_poses(start, points, uv, K),
        "OpenCV": peers.opencv_poses(start, points, uv, K),
        "theseus": torch.no_grad()(by_theseus),
    }
    return implementations, pose_error(T_cw)


def refinement_gradient(batch: int) -> tuple[Implementations, Error]:
    """Refinement of a pose, and its gradient by the weights. Error: relative difference to our gradient, %."""
    problems = Problems(batch)
    T_cw, points, uv, start = refinement_problem(problems)
    weights = (0.5 + problems.uniform(100)).requires_grad_()
    by_theseus = peers.theseus_poses(start, points, uv, K, weights)
    settings = {"pixel_sigma": 100.0, "rounds": 1, "iterations": 20, "tolerance": 1e-12}

    def gradient(T: Tensor) -> Tensor:
        return torch.autograd.grad((T[:, :3, 3] * T_cw[:, :3, 0]).sum(), weights)[0]

    def ours() -> Tensor:
        return gradient(v3d.refine_pose(start, points, uv, K, weights=weights, **settings).T_cw)

    expected = ours()
    implementations: Implementations = {OURS: ours, "theseus (implicit)": lambda: gradient(by_theseus())}
    return implementations, lambda found: 100 * float((found - expected).norm() / expected.norm())


def bundle(batch: int) -> tuple[Implementations, Error]:
    """Bundle adjustment of 5 poses, 60 points, 240 pixels with 1 pixel of noise, Huber. Error: poses, thousandths."""
    problems = Problems(batch)
    T_cw, points = se3_exp(0.2 * problems.normal(5, 6)), problems.points(60)
    pose, point = torch.arange(240) % 5, torch.arange(240) // 4
    in_camera = (T_cw[:, pose, :3, :3] @ points[:, point, :, None])[..., 0] + T_cw[:, pose, :3, 3]
    uv = CAMERA.project(in_camera) + problems.normal(240, 2)
    noise = 0.02 * problems.normal(5, 6)
    noise[:, 0] = 0
    start, first_points = se3_exp(noise) @ T_cw, points + 0.02 * problems.normal(60, 3)
    pose, point = pose.expand(batch, -1), point.expand(batch, -1)
    kornia = [
        (T[:, :3, :3].contiguous().numpy(), T[:, :3, 3].contiguous().numpy(), X.numpy(), np.column_stack([i, j, u]))
        for T, X, i, j, u in zip(start, first_points, pose.numpy(), point.numpy(), uv.numpy(), strict=True)
    ]

    def from_kornia_rs() -> Tensor:
        options = {"robust": "huber", "robust_scale": 5.991**0.5, "max_iterations": 20}
        T = torch.eye(4, dtype=torch.float64).repeat(batch, 5, 1, 1)
        for k, given in enumerate(kornia):
            try:
                R, t, *_ = kornia_rs.k3d.bundle_adjust(*given, K.numpy(), **options)
            except ValueError:  # its linear solver fails on some problems, whose poses stay as they were
                R, t = given[:2]
            T[k, :, :3, :3], T[k, :, :3, 3] = torch.as_tensor(np.array(R)), torch.as_tensor(np.array(t))
        return T

    def error(found: Tensor) -> float:
        """Poses without their scale, which pixels alone do not determine."""
        centres, true = invert(found)[..., :3, 3], invert(T_cw)[..., :3, 3]
        T = v3d.umeyama(centres, true, with_scale=True)
        return 1e3 * float((transform(T, centres) - true).norm(dim=-1).median())

    implementations: Implementations = {
        OURS: lambda: v3d.bundle_adjust(start, first_points, uv, pose, point, K, iterations=20).T_cw,
        "GTSAM": peers.gtsam_bundles(start, first_points, uv, pose, point, K, 5.991**0.5),
        "kornia-rs": from_kornia_rs,
    }
    return implementations, error


def graphs(batch: int) -> tuple[Implementations, Error]:
    """Pose graphs of 30 poses and 45 edges. Error: poses, thousandths."""
    problems = Problems(batch)
    T_wc = se3_exp(problems.normal(30, 6))
    loops = torch.randint(0, 15, (16, 2), generator=problems.generator)
    edges = torch.cat([torch.stack([torch.arange(29), torch.arange(1, 30)], 1), loops])
    edges[29:, 1] += 15
    i, j = edges.unbind(1)
    T_ij = invert(T_wc[:, i]) @ T_wc[:, j] @ se3_exp(0.01 * problems.normal(45, 6))
    error = 0.1 * problems.normal(30, 6)
    error[:, 0] = 0
    start, information = T_wc @ se3_exp(error), 1e4 * torch.eye(6, dtype=torch.float64)
    given = start, edges, T_ij, information
    implementations: Implementations = {
        OURS: lambda: v3d.optimise_pose_graph(start, edges, T_ij, information).T_wc,
        "GTSAM": peers.gtsam_graphs(*given),
        "theseus": peers.theseus_graphs(*given),
        "PyPose": peers.pypose_graphs(*given),
    }
    return implementations, pose_error(T_wc)


def dense(batch: int) -> tuple[Implementations, Error]:
    """Motion between two images of 320x240 pixels of a wavy, textured wall. Error: pose, thousandths."""
    camera = v3d.PinholeCamera(262.5, 262.5, 159.5, 119.5, width=320, height=240)
    T_ba = se3_exp(torch.tensor([0.02, -0.01, 0.015, 0.01, -0.015, 0.02], dtype=torch.float64))
    images = []
    for T_ca in (torch.eye(4, dtype=torch.float64), T_ba):
        T_ac, z = invert(T_ca), torch.full((240, 320), 2.0, dtype=torch.float64)
        rays = camera.rays.double()
        for _ in range(20):  # the intersection of each ray with the surface z = 2 + 0.1 sin(3 x)
            at = transform(T_ac, (rays * z[..., None]).reshape(1, -1, 3)).reshape(240, 320, 3)
            z = z + (2 + 0.1 * torch.sin(3 * at[..., 0]) - at[..., 2])
        grey = 0.5 + 0.2 * torch.sin(9 * at[..., 0]) * torch.sin(7 * at[..., 1] + at[..., 0])
        images.append((grey.float()[None], z.float()[None]))
    (grey_a, depth_a), (grey_b, depth_b) = images
    stacked = [each.expand(batch, -1, -1, -1) for each in (grey_a, depth_a, grey_b, depth_b)]
    align = v3d.DenseAligner(v3d.Config().dense_odometry, camera)
    intrinsics = o3d.camera.PinholeCameraIntrinsic(320, 240, 262.5, 262.5, 159.5, 119.5)
    rgbd = [
        o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image((255 * grey[0].numpy()).astype(np.uint8)),
            o3d.geometry.Image(depth[0].numpy()),
            depth_scale=1.0,
            depth_trunc=10.0,
        )
        for grey, depth in images
    ]
    hybrid = o3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm()

    def open3d() -> Tensor:
        odometry = o3d.pipelines.odometry.compute_rgbd_odometry
        return torch.stack(
            [torch.from_numpy(odometry(*rgbd, intrinsics, np.eye(4), hybrid)[1].copy()) for _ in range(batch)]
        )

    return {OURS: lambda: align(*stacked).T_ba, "Open3D": open3d}, pose_error(T_ba)


def alignment(batch: int) -> tuple[Implementations, Error]:
    """Umeyama alignment of 1000 points. Error: largest difference to evo, thousandths."""
    problems = Problems(batch)
    p = problems.normal(1000, 3)
    q = transform(se3_exp(problems.normal(6)), p) + 0.01 * problems.normal(1000, 3)
    arrays = list(zip(p.numpy(), q.numpy(), strict=True))

    def evo() -> Tensor:
        T = torch.eye(4, dtype=torch.float64).repeat(batch, 1, 1)
        for k, (a, b) in enumerate(arrays):
            R, t, _ = umeyama_alignment(a.T, b.T)
            T[k, :3, :3], T[k, :3, 3] = torch.from_numpy(R), torch.from_numpy(t)
        return T

    expected = evo()
    return {OURS: lambda: v3d.umeyama(p, q), "evo": evo}, lambda found: 1e3 * float((found - expected).abs().max())


PROBLEMS: dict[str, Callable[[int], tuple[Implementations, Error]]] = {
    "match_descriptors": matching,
    "essential_ransac": essential,
    "pnp_ransac": pnp,
    "refine_pose": refinement,
    "refine_pose, gradient": refinement_gradient,
    "bundle_adjust": bundle,
    "optimise_pose_graph": graphs,
    "align_depth": dense,
    "umeyama": alignment,
}
