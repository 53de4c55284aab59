"""Cases of the public modules: each with its functional form, and inputs of any size and dtype."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

import v3d_torch as v3d
from helpers import camera_inputs
from v3d_torch.geometry.se3 import se3_exp

CAMERA = v3d.PinholeCamera(fx=12.0, fy=11.0, cx=4.5, cy=3.5, width=10, height=8)
Inputs = dict[str, Tensor]
Make = Callable[[int, int, torch.dtype], Inputs]


def random(*shape: int, dtype: torch.dtype, seed: int = 0) -> Tensor:
    """Reproducible random numbers in [0, 1), equal for all dtypes."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def random_mask(batch: int, count: int, seed: int = 1) -> Tensor:
    """Mask that is false for about a third of the elements and for the whole second row."""
    mask = random(batch, count, dtype=torch.float64, seed=seed) < 0.67
    mask[1:2] = False
    return mask


def image(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Noisy depth with a step and holes; the size is the camera's, ``count`` is not used."""
    shape = (batch, 1, CAMERA.height, CAMERA.width)
    depth = 1 + 0.1 * random(*shape, dtype=dtype) + (torch.arange(CAMERA.width) > 5)
    return {"depth": depth * (random(*shape, dtype=dtype, seed=2) < 0.8)}


def cloud(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    return {"points": random(batch, count, 3, dtype=dtype), "valid": random_mask(batch, count)}


def clustered(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    labels = (9 * random(batch, count, dtype=torch.float64)).to(torch.int64) - 1
    return {"labels": labels, "valid": random_mask(batch, count)}


def centroids(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    previous, current = (random(batch, count, 3, dtype=dtype, seed=seed) for seed in (2, 3))
    return {"previous": previous, "current": current, "present": random_mask(batch, count)}


def pair(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    p, q = random(batch, count, 3, dtype=dtype), random(batch, count, 3, dtype=dtype, seed=4)
    return {"p": p, "q": q, "p_valid": random_mask(batch, count), "q_valid": random_mask(batch, count, 5)}


def clouds_of_two_frames(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    p, q, p_valid, q_valid = pair(batch, count, dtype).values()
    T_current_previous = se3_exp(0.3 * random(batch, 6, dtype=torch.float64)).to(dtype)
    return {
        "previous": p,
        "current": q,
        "previous_valid": p_valid,
        "current_valid": q_valid,
        "T_current_previous": T_current_previous,
    }


def surface(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Points of a wavy wall, one per pixel; ``count`` is not used."""
    v, u = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    z = 2 + 0.1 * torch.sin(u + v + random(batch, 1, 1, dtype=torch.float64))
    return {"points": (CAMERA.rays * z[..., None]).to(dtype)}


def log_ratios(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Log-likelihood ratios of some objects and instances; ``count`` is the number of both."""
    ratio = 2 * random(batch, count, count, dtype=dtype) - 1
    return {"log_ratio": ratio, "tracked": random_mask(batch, count), "present": random_mask(batch, count, 5)}


def two_images(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Two images of a textured wall, slightly shifted; ``count`` is not used."""
    v, u = torch.meshgrid(torch.arange(CAMERA.height), torch.arange(CAMERA.width), indexing="ij")
    inputs = {}
    for name, shift in (("a", 0.0), ("b", 0.1)):
        grey = 0.5 + 0.2 * torch.sin(0.9 * (u + shift)) * torch.cos(0.8 * v)
        depth = 2 + 0.1 * torch.sin(0.5 * (u + shift) + 0.3 * v)
        inputs |= {f"grey_{name}": grey, f"depth_{name}": depth}
    return {name: each.to(dtype).repeat(batch, 1, 1, 1) for name, each in inputs.items()}


@dataclass(frozen=True)
class Case:
    """A public function, its form as a module, and their inputs.

    Attributes:
        module: The module; None if the function has no such form.
        function: The function with the same settings.
        inputs: Function from batch size, number of elements and dtype to the inputs.
        masks: Name of the mask of each padded argument.
        differentiable: Names of the arguments with a gradient.
        sampled: True if compiled code draws other random samples than torch.
        gradcheck: False for functions whose own tests check the gradients: those of iterative solvers need converged
            finite differences, those of poses need changes that are rigid motions.
    """

    module: torch.nn.Module | None
    function: Callable[..., object]
    inputs: Make
    masks: dict[str, str]
    differentiable: tuple[str, ...] = ()
    gradcheck: bool = True
    sampled: bool = False


CLOUD, PAIR = {"points": "valid"}, {"p": "p_valid", "q": "q_valid"}
CENTROIDS, TWICE = (
    {"previous": "present", "current": "present"},
    {"previous": "previous_valid", "current": "current_valid"},
)
CASES = {
    "DepthSmoother": Case(
        v3d.DepthSmoother(3, 0.8, 0.03),
        partial(v3d.smooth_depth, kernel_size=3, sigma=0.8, edge_ratio=0.03),
        image,
        {},
        ("depth",),
    ),
    "BackProjector": Case(
        v3d.BackProjector(CAMERA), partial(v3d.back_project, rays=CAMERA.rays), image, {}, ("depth",)
    ),
    "VoxelPool": Case(v3d.VoxelPool(0.3), partial(v3d.voxel_pool, size=0.3), cloud, CLOUD, ("points",)),
    "DBSCAN": Case(v3d.DBSCAN(0.15, 3), partial(v3d.dbscan, eps=0.15, min_samples=3), cloud, CLOUD),
    "LargestClusters": Case(
        v3d.LargestClusters(2), partial(v3d.largest_clusters, min_points=2), clustered, {"labels": "valid"}
    ),
    "HoughVoting": Case(
        v3d.HoughVoting(0.2, 2),
        partial(v3d.hough_vote, distance_threshold=0.2, vote_threshold=2),
        centroids,
        CENTROIDS,
        ("previous", "current"),
    ),
    "soft HoughVoting": Case(
        v3d.HoughVoting(0.2, 2, temperature=0.1),
        partial(v3d.hough_vote, distance_threshold=0.2, vote_threshold=2, temperature=0.1),
        centroids,
        CENTROIDS,
        ("previous", "current"),
    ),
    "ChamferDistance": Case(v3d.ChamferDistance(), v3d.chamfer_distance, pair, PAIR, ("p", "q")),
    "IntraObjectMotion": Case(
        v3d.IntraObjectMotion(0.2),
        partial(v3d.intra_object_motion, distance_threshold=0.2),
        clouds_of_two_frames,
        TWICE,
        ("previous", "current", "T_current_previous"),
    ),
}
CAMERA_CASES = {
    "DescriptorMatcher": Case(
        v3d.DescriptorMatcher(60, 0.9),
        partial(v3d.match_descriptors, max_hamming=60, max_ratio=0.9),
        camera_inputs.descriptors,
        {"a": "a_valid", "b": "b_valid"},
    ),
    "EssentialRANSAC": Case(
        v3d.EssentialRANSAC(2.0, 50),
        partial(v3d.essential_ransac, threshold=2.0, iterations=50),
        camera_inputs.two_views,
        {"uv_a": "valid", "uv_b": "valid"},
        ("uv_a", "uv_b", "K"),
        gradcheck=False,
        sampled=True,
    ),
    "PnPRANSAC": Case(
        v3d.PnPRANSAC(3.0, 50),
        partial(v3d.pnp_ransac, threshold=3.0, iterations=50),
        camera_inputs.points_in_view,
        {"points": "valid", "uv": "valid"},
        ("points", "uv", "K"),
        gradcheck=False,
        sampled=True,
    ),
    "PoseRefiner": Case(
        v3d.PoseRefiner(1.0, 0.02, rounds=1, iterations=30, tolerance=1e-14),
        partial(v3d.refine_pose, inverse_depth_sigma=0.02, rounds=1, iterations=30, tolerance=1e-14),
        camera_inputs.view,
        dict.fromkeys(("points", "uv", "inverse_depth", "weights"), "valid"),
        ("points", "uv", "K", "weights"),
        gradcheck=False,
    ),
    "BundleAdjuster": Case(
        v3d.BundleAdjuster(1.0, 0.02, iterations=5),
        partial(v3d.bundle_adjust, inverse_depth_sigma=0.02, iterations=5),
        camera_inputs.bundle,
        dict.fromkeys(("uv", "pose", "point", "inverse_depth", "weights"), "valid"),
        ("uv", "weights"),
        gradcheck=False,
    ),
    "ReadoutEstimator": Case(
        v3d.ReadoutEstimator(1.0, 0.02),
        partial(v3d.estimate_readout, inverse_depth_sigma=0.02),
        camera_inputs.calibration,
        dict.fromkeys(("readout_jacobian", "uv", "pose", "point", "inverse_depth", "weights"), "valid"),
        ("readout_jacobian", "uv", "weights"),
        gradcheck=False,
    ),
    "PoseGraphOptimiser": Case(
        v3d.PoseGraphOptimiser(5),
        partial(v3d.optimise_pose_graph, iterations=5),
        camera_inputs.graph,
        dict.fromkeys(("edges", "T_ij", "information", "weights"), "valid"),
        ("weights",),
        gradcheck=False,
    ),
    "RollingShutterCompensation": Case(
        v3d.RollingShutterCompensation(0.02, 480),
        partial(v3d.compensate_rolling_shutter, readout=0.02, height=480),
        camera_inputs.rolling,
        dict.fromkeys(("uv", "row", "inverse_depth", "readout_jacobian"), "valid"),
        ("uv", "row", "inverse_depth", "velocity", "K", "readout_jacobian"),
    ),
    "RelativePoseError": Case(
        v3d.RelativePoseError(3.0),
        partial(v3d.rpe, delta=3.0),
        camera_inputs.trajectories,
        dict.fromkeys(("T_gc", "T_ec", "stamps"), "valid"),
        ("T_gc", "T_ec"),
        gradcheck=False,
    ),
}
CASES |= CAMERA_CASES


FUNCTION_CASES = {
    "se3_exp": Case(None, v3d.se3_exp, camera_inputs.twists, {}, ("xi",)),
    "se3_log": Case(None, v3d.se3_log, camera_inputs.motions, {}, ("T",)),
    "surface_normals": Case(None, partial(v3d.surface_normals, radius=1), surface, {}, ("points",)),
    "match_instances": Case(None, v3d.match_instances, log_ratios, {"log_ratio": "tracked"}),
    "umeyama": Case(
        None, v3d.umeyama, camera_inputs.correspondences, {"p": "valid", "q": "valid"}, ("p", "q", "weights")
    ),
    "ate": Case(None, v3d.ate, camera_inputs.positions, {"T_gc": "valid", "T_ec": "valid"}, ("T_gc", "T_ec")),
    "align_depth": Case(None, partial(v3d.align_depth, camera=CAMERA), two_images, {}),
}
"""Public functions without a module, and one whose module has other parameters."""


def tensors(result: object) -> tuple[Tensor, ...]:
    return (result,) if isinstance(result, Tensor) else tuple(result)  # type: ignore[call-overload]


def without_padding(found: Tensor, expected: Tensor) -> Tensor:
    """A result without the padding at the end that the expected result does not have."""
    return found[tuple(map(slice, expected.shape))] if found.ndim else found
