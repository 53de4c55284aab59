"""Degenerate geometry and large coordinates, stage by stage: a correct result or none, never NaN or a wrong result.

Points on a plane, on a line, in one place, or only three; a camera that only rotates or is at rest; identical clouds;
and worlds whose origin is a kilometre away, where float32 resolves a tenth of a millimetre.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sklearn.cluster
import torch
from helpers import box_room
from helpers.sparse_maps import uniform
from torch import Tensor

from v3d_torch.backend.pose_graph import optimise_pose_graph
from v3d_torch.config import Config
from v3d_torch.evaluation import evaluate
from v3d_torch.evaluation.ate import RotationSource, absolute_errors, align, scale_error
from v3d_torch.features.features import Features
from v3d_torch.features.fundamental_ransac import epipolar_inliers
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.normals import surface_normals
from v3d_torch.geometry.se3 import invert, orthonormalise, se3_exp, se3_log
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.mapping.bundle_adjustment import bundle_adjust
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.objects.chamfer import chamfer_distance
from v3d_torch.objects.dbscan import dbscan
from v3d_torch.objects.intra_object_motion import intra_object_motion
from v3d_torch.objects.voting import hough_vote
from v3d_torch.odometry.motion_estimator import MotionEstimator
from v3d_torch.optim.pose_refinement import refine_pose
from v3d_torch.reconstruction.mesh import fuse_mesh
from v3d_torch.types import Trajectory

CAMERA = PinholeCamera(fx=535.4, fy=539.2, cx=320.1, cy=247.6)
KILOMETRE = torch.tensor([1024.0, -512.0, 768.0], dtype=torch.float64)
"""Offset from the origin, metres: exact in every dtype, and a multiple of the voxel size 2**-6 m."""

TURN = torch.tensor([0.0, 0.0, 0.0, 0.03, -0.05, 0.02], dtype=torch.float64)
STEP = torch.tensor([0.04, -0.02, 0.03, 0.0, 0.0, 0.0], dtype=torch.float64)


def points(shape: str, count: int = 200) -> Tensor:
    """Points in front of the camera on a lattice of 2**-10 m, whose differences are exact at the offset, too."""
    box = torch.stack([2 * uniform(count, seed=1) - 1, 1.5 * uniform(count, seed=2) - 0.75, 2 + uniform(count, seed=3)])
    x, y, z = box
    cloud = {
        "plane": torch.stack([x, y, torch.full_like(z, 2.5)], dim=1),
        "slope": torch.stack([x, y, 2.5 + 0.25 * x], dim=1),
        "line": torch.stack([x, 0.5 * x, 2.5 + 0.25 * x], dim=1),
        "place": torch.tensor([[0.25, -0.125, 2.5]], dtype=torch.float64).repeat(count, 1),
        "three": torch.tensor([[0.5, 0.0, 2.0], [-0.5, 0.25, 2.5], [0.0, -0.5, 3.0]], dtype=torch.float64),
        "room": torch.stack([x, y, z], dim=1),
    }[shape]
    return (cloud * 1024).round() / 1024


SHAPES = ("plane", "slope", "line", "place", "three")
each_shape = pytest.mark.parametrize("shape", SHAPES)


def all_valid(cloud: Tensor) -> Tensor:
    return torch.ones(cloud.shape[:-1], dtype=torch.bool)


# ---- objects -------------------------------------------------------------------------------------------------------


@each_shape
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_dbscan_of_degenerate_clouds_equals_sklearn(shape: str, offset: float) -> None:
    cloud = points(shape) + offset * KILOMETRE
    expected = sklearn.cluster.DBSCAN(eps=0.1, min_samples=4).fit(points(shape).numpy()).labels_
    np.testing.assert_array_equal(dbscan(cloud[None], all_valid(cloud[None]), 0.1, 4)[0].numpy(), expected)


@each_shape
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_voxel_means_of_degenerate_clouds(shape: str, dtype: torch.dtype) -> None:
    size = 2.0**-6
    cloud = points(shape)
    cells, inverse = np.unique(np.floor(cloud.numpy() / size), axis=0, return_inverse=True)
    expected = np.stack([cloud.numpy()[inverse.ravel() == k].mean(axis=0) for k in range(len(cells))])
    for offset in (torch.zeros(3, dtype=torch.float64), KILOMETRE):
        pooled = voxel_pool((cloud + offset)[None].to(dtype), all_valid(cloud[None]), size)
        assert pooled.means.isfinite().all() and int(pooled.counts.sum()) == len(cloud)
        rounding = 1e-9 if dtype == torch.float64 else 2e-6 + 4e-7 * float(offset.abs().max())
        np.testing.assert_allclose((pooled.means[0] - offset.to(dtype)).numpy(), expected, atol=rounding, rtol=0)


@each_shape
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_chamfer_of_identical_clouds_is_zero(shape: str, dtype: torch.dtype) -> None:
    cloud = (points(shape) + KILOMETRE).to(dtype)[None].requires_grad_()
    assert chamfer_distance(cloud, cloud.detach()[:, torch.randperm(cloud.shape[1])]).item() == 0.0
    motion = intra_object_motion(cloud, cloud.detach(), 0.05)
    assert motion.distance.item() == 0.0 and not motion.deforming
    motion.distance.sum().backward()
    assert cloud.grad is not None and cloud.grad.isfinite().all()


@each_shape
def test_chamfer_distance_far_from_the_origin(shape: str) -> None:
    """Compared with all pairs; an offset of both clouds does not change the distance."""
    p, q = points(shape), points(shape) + torch.tensor([0.0, 0.0, 0.125], dtype=torch.float64)
    squared = (p[:, None] - q).square().sum(dim=-1)
    expected = squared.min(dim=1).values.mean() + squared.min(dim=0).values.mean()
    for offset in (0.0, 1.0):
        distance = chamfer_distance((p + offset * KILOMETRE)[None], (q + offset * KILOMETRE)[None])
        assert distance.item() == pytest.approx(expected.item(), rel=1e-5)


@each_shape
def test_static_objects_get_no_votes(shape: str) -> None:
    """Whatever the arrangement of the objects and the pose of the camera."""
    centroids = points(shape, 12)
    moved = centroids @ se3_exp(TURN)[:3, :3].T + KILOMETRE
    votes = hough_vote(centroids, moved, all_valid(centroids), distance_threshold=1e-9, vote_threshold=1)
    assert not votes.dynamic.any() and votes.change.max() < 1e-9


@pytest.mark.parametrize("temperature", [None, 0.01])
def test_votes_between_centroids_that_coincide(temperature: float | None) -> None:
    """All in one place, then one leaves: it gets a vote from each other object, and each of these one from it."""
    previous = points("place", 5).requires_grad_()
    current = previous.detach().clone()
    current[2, 0] += 0.5
    votes = hough_vote(previous, current, all_valid(current), 0.25, vote_threshold=2, temperature=temperature)
    assert votes.dynamic.tolist() == [False, False, True, False, False]
    torch.testing.assert_close(votes.votes, votes.votes.new_tensor([1, 1, 4, 1, 1]), atol=1e-9, rtol=0)
    if temperature is not None:
        votes.votes.sum().backward()
        assert previous.grad is not None and previous.grad.isfinite().all()


def test_votes_a_kilometre_away_are_the_same() -> None:
    previous = points("room", 30)
    current = previous + 0.1 * (uniform(30, 3, seed=4) - 0.5)
    near = hough_vote(previous, current, all_valid(current), 0.05, 3)
    far = hough_vote(previous + KILOMETRE, current + KILOMETRE, all_valid(current), 0.05, 3)
    assert 0 < near.dynamic.sum() < 30
    torch.testing.assert_close(far.change, near.change, atol=1e-11, rtol=0)
    assert torch.equal(far.votes, near.votes)


# ---- camera motion ------------------------------------------------------------------------------------------------


def views(cloud: Tensor, T_ba: Tensor) -> tuple[Features, Features]:
    """Features of points in two views, each point with a descriptor of its own."""
    descriptors = torch.randint(0, 256, (len(cloud), 32), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)

    def view(in_camera: Tensor) -> Features:
        uv = CAMERA.project(in_camera)
        return Features(uv, uv.round().long(), in_camera[:, 2], torch.zeros(len(cloud), dtype=torch.int64), descriptors)

    return view(cloud), view(cloud @ T_ba[:3, :3].T + T_ba[:3, 3])


MOTIONS = {"turn": TURN, "step": STEP, "stand": 0 * TURN, "both": TURN + STEP}


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("shape", ["plane", "slope", "room"])
def test_motion_in_front_of_a_plane_or_with_pure_rotation(shape: str, motion: str) -> None:
    """The fundamental matrix is not determined, but the pose is."""
    T_ba = se3_exp(MOTIONS[motion])
    a, b = views(points(shape), T_ba)
    assert epipolar_inliers(a.uv, b.uv, threshold=1.0, iterations=200, seed=0).float().mean() > 0.9
    found = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)(a, b)
    assert found is not None
    assert se3_log(found.T_ba @ invert(T_ba)).abs().max() < 1e-5


@pytest.mark.parametrize("motion", MOTIONS)
def test_motion_that_points_on_a_line_do_not_determine_explains_them(motion: str) -> None:
    T_ba = se3_exp(MOTIONS[motion])
    a, b = views(points("line"), T_ba)
    found = MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)(a, b)
    assert found is not None and len(found.inlier_matches) == len(a)
    moved = points("line")[found.inlier_matches[:, 0]] @ found.T_ba[:3, :3].T + found.T_ba[:3, 3]
    assert (CAMERA.project(moved) - b.uv[found.inlier_matches[:, 1]]).norm(dim=1).max() < 3


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("shape", ["place", "three"])
def test_motion_of_points_at_fewer_than_four_places_is_not_found(shape: str, motion: str) -> None:
    a, b = views(points(shape), se3_exp(MOTIONS[motion]))
    assert MotionEstimator(Config().odometry, Config().features, CAMERA, seed=0)(a, b) is None


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("offset", [0.0, 1.0])
@pytest.mark.parametrize("shape", [*SHAPES, "room"])
def test_refined_pose_of_degenerate_points(shape: str, offset: float, depth: bool) -> None:
    """All residuals vanish; if the points determine the pose, it is the true one, also a kilometre from the origin."""
    cloud = points(shape)
    T_cw = se3_exp(TURN + STEP)
    T_cw[:3, 3] -= T_cw[:3, :3] @ (offset * KILOMETRE)
    in_camera = (cloud + offset * KILOMETRE) @ T_cw[:3, :3].T + T_cw[:3, 3]
    measured = {
        "uv": CAMERA.project(in_camera),
        "inverse_depth": (1 / in_camera[:, 2]) * depth,
        "inverse_depth_sigma": 0.0025,
    }
    start = se3_exp(torch.tensor([0.01, 0.01, -0.01, 0.005, 0.005, -0.005], dtype=torch.float64)) @ T_cw
    found = refine_pose(start, cloud + offset * KILOMETRE, K=CAMERA.K, **measured, iterations=20)
    assert found.T_cw.dtype == torch.float64 and found.T_cw.isfinite().all()
    assert found.inliers.all() and found.chi2.max() < 1e-3
    if shape in ("plane", "slope", "room") or (shape == "three" and depth):
        assert (found.T_cw @ invert(T_cw) - torch.eye(4, dtype=torch.float64)).abs().max() < 1e-5


# ---- the map -------------------------------------------------------------------------------------------------------


def observe_all(cloud: Tensor, T_cw: Tensor) -> dict[str, Any]:
    """Exact observations of every point by every camera, with depth."""
    pose = torch.arange(len(T_cw)).repeat_interleave(len(cloud))
    in_camera = (T_cw[:, None, :3, :3] @ cloud[..., None])[..., 0] + T_cw[:, None, :3, 3]
    in_camera = in_camera.reshape(-1, 3)
    return {
        "uv": CAMERA.project(in_camera),
        "pose": pose,
        "point": torch.arange(len(cloud)).repeat(len(T_cw)),
        "K": CAMERA.K,
        "inverse_depth": 1 / in_camera[:, 2],
        "inverse_depth_sigma": 0.0025,
    }


@pytest.mark.parametrize("cameras", ["stand", "turn", "line"])
@pytest.mark.parametrize("offset", [0.0, 1.0])
@pytest.mark.parametrize("shape", [*SHAPES, "room"])
def test_bundle_adjustment_of_degenerate_maps(shape: str, offset: float, cameras: str) -> None:
    """What the observations determine is correct, and what they do not determine stays near its start."""
    cloud = points(shape, 40) + offset * KILOMETRE
    pace = {"stand": 0 * TURN, "turn": TURN, "line": STEP}[cameras]
    T_cw = se3_exp(torch.arange(4, dtype=torch.float64)[:, None] * pace)
    T_cw[:, :3, 3] -= T_cw[:, :3, :3] @ (offset * KILOMETRE)
    fixed = torch.tensor([True, False, False, False])
    wrong = 0.005 * (uniform(4, 6, seed=5) - 0.5) * ~fixed[:, None]
    observations = observe_all(cloud, T_cw)
    start = cloud + 0.01 * (uniform(len(cloud), 3, seed=6) - 0.5)
    found = bundle_adjust(se3_exp(wrong) @ T_cw, start, **observations, fixed=fixed, iterations=30)
    assert found.T_cw.dtype == found.points.dtype == torch.float64
    assert found.T_cw.isfinite().all() and found.points.isfinite().all()
    assert torch.equal(found.T_cw[0], T_cw[0])
    assert found.cost_after <= 1e-4 * found.cost_before
    assert (found.points - cloud).norm(dim=1).max() < 0.05
    if shape in ("plane", "slope", "room"):
        assert (found.points - cloud).norm(dim=1).max() < 1e-4
        assert se3_log(found.T_cw @ invert(T_cw)).abs().max() < 1e-4


@pytest.mark.parametrize("offset", [0.0, 1.0])
@pytest.mark.parametrize("walk", ["stand", "turn", "line", "half turns"])
def test_pose_graph_of_degenerate_trajectories(walk: str, offset: float) -> None:
    """Poses in one place, on a line, or with rotations up to half a turn; some edges are duplicated."""
    half = torch.tensor([0.1, 0.0, 0.0, 0.0, 3.1, 0.0], dtype=torch.float64)
    pace = {"stand": 0 * TURN, "turn": TURN, "line": STEP, "half turns": half}[walk]
    T_wc = [torch.eye(4, dtype=torch.float64)]
    T_wc[0][:3, 3] = offset * KILOMETRE
    for _ in range(9):
        T_wc.append(T_wc[-1] @ se3_exp(pace))
    true = torch.stack(T_wc)
    edges = torch.tensor([(k, k + 1) for k in range(9)] * 2 + [(0, 9), (9, 0)])
    T_ij = invert(true[edges[:, 0]]) @ true[edges[:, 1]]
    wrong = 0.02 * (uniform(10, 6, seed=7) - 0.5)
    wrong[0] = 0
    found = optimise_pose_graph(true @ se3_exp(wrong), edges, T_ij)
    assert found.T_wc.dtype == torch.float64 and found.T_wc.isfinite().all()
    torch.testing.assert_close(found.T_wc, true, atol=1e-6 if offset else 1e-7, rtol=0)
    solved = optimise_pose_graph(true, edges, T_ij)  # already optimal
    torch.testing.assert_close(solved.T_wc, true, atol=1e-9, rtol=0)


def test_pose_graph_without_edges_or_free_poses_is_unchanged() -> None:
    T_wc = se3_exp(uniform(3, 6, seed=0))
    nothing = torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0, 4, 4, dtype=torch.float64)
    torch.testing.assert_close(optimise_pose_graph(T_wc, *nothing).T_wc, T_wc, atol=1e-12, rtol=0)
    edge = torch.tensor([[0, 1]]), torch.eye(4, dtype=torch.float64)[None]
    fixed = torch.ones(3, dtype=torch.bool)
    assert torch.equal(optimise_pose_graph(T_wc, *edge, fixed=fixed).T_wc, T_wc)


@pytest.mark.parametrize("size", [(1, 1), (1, 20), (20, 1), (2, 2)])
@pytest.mark.parametrize("z", [0.0, 2.0, 1000.0])
def test_normals_of_images_without_interior_pixels_are_zero(size: tuple[int, int], z: float) -> None:
    image = torch.cat([uniform(1, *size, 2, seed=0), torch.full((1, *size, 1), z, dtype=torch.float64)], dim=-1)
    assert not surface_normals(image).any()


def test_normals_of_coincident_points_are_zero() -> None:
    normals = surface_normals(torch.tensor([0.0, 0.0, 2.0]).expand(1, 9, 9, 3))
    assert normals.isfinite().all() and not normals.any()


@pytest.mark.parametrize("offset", [0.0, 1.0])
@pytest.mark.parametrize("shape", ["plane", "line", "place", "three"])
def test_mesh_of_degenerate_depth(shape: str, offset: float) -> None:
    """A wall has a mesh; a line, one pixel and three pixels have almost none, also a kilometre from the origin."""
    depth = torch.zeros(240, 320)
    pixels = {
        "plane": (slice(None), slice(None)),
        "line": (slice(120, 121), slice(None)),
        "place": (slice(120, 121), slice(150, 151)),
        "three": ([50, 100, 150], [50, 250, 150]),
    }[shape]
    depth[pixels] = 2.0
    T_cw = torch.eye(4, dtype=torch.float64)
    T_cw[:3, 3] = -offset * KILOMETRE
    views = StaticViews(box_room.CAMERA, 2)
    grey = torch.full((3, 240, 320), 128, dtype=torch.uint8)
    views.add(box_room.keyframe(T_cw), grey, depth[None], depth > 0)
    mesh = fuse_mesh(views, Config().dense_map)
    assert mesh.vertices.isfinite().all() and mesh.normals.isfinite().all()
    assert ((mesh.vertices[:, 2].double() - offset * KILOMETRE[2] - 2.0).abs() < 0.03).all()
    assert (len(mesh.faces) > 1000) == (shape == "plane")


# ---- evaluation ----------------------------------------------------------------------------------------------------


def trajectory(shape: str, offset: float) -> Trajectory:
    """Trajectory of a rotating camera through the points, with realistic stamps."""
    places = points(shape, 60) - torch.tensor([0.0, 0.0, 2.5], dtype=torch.float64)
    T_wc = se3_exp(torch.linspace(0, 1, len(places), dtype=torch.float64)[:, None] * 10 * TURN)
    T_wc[:, :3, 3] = places + offset * KILOMETRE
    return Trajectory(1.3e9 + torch.arange(len(places), dtype=torch.float64) / 2, T_wc)


@pytest.mark.parametrize("offset", [0.0, 1.0])
@pytest.mark.parametrize("shape", [*SHAPES, "room"])
def test_errors_of_a_perfect_estimate_are_zero(shape: str, offset: float) -> None:
    """The estimate is in another world frame, a kilometre away; the alignment is a proper rotation."""
    truth = trajectory(shape, offset)
    T_ew = se3_exp(torch.tensor([3.0, -2.0, 1.0, 1.0, -2.0, 0.5], dtype=torch.float64))
    estimate = replace(truth, T_wc=T_ew @ truth.T_wc)
    scores = evaluate(truth, estimate)
    assert scores.ate.max < 1e-9
    if shape != "three":  # this trajectory is too short for the RPE over one second
        assert scores.rpe is not None and scores.rpe.trans.max < 1e-9 and scores.rpe.rot.max < 1e-5
    R = scores.alignment.T_ge[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
    assert torch.linalg.det(R).item() == pytest.approx(1.0)
    assert (scores.alignment.source is RotationSource.ORIENTATIONS) == (shape in ("line", "place"))
    torch.testing.assert_close(scores.alignment.T_ge, invert(T_ew), atol=1e-7, rtol=0)


@pytest.mark.parametrize("oriented", [True, False])
@pytest.mark.parametrize("shape", ["line", "place"])
def test_alignment_of_degenerate_positions_is_rigid(shape: str, oriented: bool) -> None:
    """Also for an estimate at rest, and with positions only."""
    truth = trajectory(shape, 1.0)
    at_rest = trajectory("place", 0.0).T_wc[: len(truth)]
    for estimate in (truth.T_wc, at_rest):
        found = align(truth.T_wc, estimate, oriented=oriented)
        assert found.T_ge.isfinite().all()
        torch.testing.assert_close(found.T_ge, orthonormalise(found.T_ge), atol=1e-9, rtol=0)
        assert absolute_errors(truth.T_wc, estimate, found).isfinite().all()
        assert scale_error(truth.T_wc, estimate, found) is None


# ---- rigid motions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1.0, torch.pi - 1e-9, torch.pi])
def test_logarithm_of_any_rotation_angle(angle: float) -> None:
    xi = torch.tensor([1024.0, -512.0, 768.0, 0.6 * angle, 0.0, 0.8 * angle], dtype=torch.float64)
    T = se3_exp(xi)
    assert se3_log(T).isfinite().all()
    torch.testing.assert_close(se3_exp(se3_log(T)), T, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(T @ invert(T), torch.eye(4, dtype=torch.float64), atol=1e-8, rtol=0)
