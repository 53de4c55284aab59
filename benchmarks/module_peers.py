"""Problems of the camera modules, formulated for other libraries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import gtsam
import numpy as np
import pypose as pp
import theseus as th
import torch
from torch import Tensor

from v3d_torch.geometry.se3 import invert

Solve = Callable[[], Tensor]


def default_usac_options(threshold: float) -> cv2.UsacParams:
    """OpenCV's default options of USAC, with 300 hypotheses."""
    options = cv2.UsacParams()
    options.threshold, options.maxIterations, options.confidence = threshold, 300, 0.999
    return options


def gtsam_camera(K: Tensor) -> gtsam.Cal3_S2:
    """Camera matrix in the type of GTSAM."""
    return gtsam.Cal3_S2(float(K[0, 0]), float(K[1, 1]), 0.0, float(K[0, 2]), float(K[1, 2]))


def gtsam_bundles(T_cw: Tensor, points: Tensor, uv: Tensor, pose: Tensor, point: Tensor, K: Tensor, k: float) -> Solve:
    """Bundle adjustments of pixels with Huber's loss, the first pose of each fixed; poses ``T_cw`` (B, P, 4, 4)."""
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(k), gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    )
    camera, problems, first_point = gtsam_camera(K), [], T_cw.shape[1]
    for poses, landmarks, pixels, i, j in zip(invert(T_cw), points, uv, pose.tolist(), point.tolist(), strict=True):
        graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, T_wc in enumerate(poses):
            start.insert(key, gtsam.Pose3(T_wc.numpy()))
        for key, landmark in enumerate(landmarks, first_point):
            start.insert(key, gtsam.Point3(landmark.numpy()))
        graph.add(gtsam.NonlinearEqualityPose3(0, start.atPose3(0)))
        for pixel, a, b in zip(pixels, i, j, strict=True):
            graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel.numpy(), noise, a, first_point + b, camera))
        problems.append((graph, start))
    keys = range(T_cw.shape[1])

    def solve() -> Tensor:
        found = [gtsam.LevenbergMarquardtOptimizer(*problem).optimize() for problem in problems]
        return invert(torch.from_numpy(np.stack([[each.atPose3(key).matrix() for key in keys] for each in found])))

    return solve


def gtsam_poses(T_cw: Tensor, points: Tensor, uv: Tensor, K: Tensor) -> Solve:
    """Poses ``T_cw`` (B, 4, 4) from fixed points (B, N, 3), least squares of pixels."""
    noise, camera, problems = gtsam.noiseModel.Isotropic.Sigma(2, 1.0), gtsam_camera(K), []
    for T_wc, landmarks, pixels in zip(invert(T_cw), points, uv, strict=True):
        graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        start.insert(0, gtsam.Pose3(T_wc.numpy()))
        for key, (landmark, pixel) in enumerate(zip(landmarks, pixels, strict=True), 1):
            start.insert(key, gtsam.Point3(landmark.numpy()))
            graph.add(gtsam.NonlinearEqualityPoint3(key, gtsam.Point3(landmark.numpy())))
            graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel.numpy(), noise, 0, key, camera))
        problems.append((graph, start))

    def solve() -> Tensor:
        found = [gtsam.LevenbergMarquardtOptimizer(*problem).optimize().atPose3(0).matrix() for problem in problems]
        return invert(torch.from_numpy(np.stack(found)))

    return solve


def gtsam_graphs(T_wc: Tensor, edges: Tensor, T_ij: Tensor, information: Tensor) -> Solve:
    """Pose graphs, the first pose of each fixed; poses ``T_wc`` (B, N, 4, 4)."""
    rotation_first, problems = [3, 4, 5, 0, 1, 2], []
    noise = gtsam.noiseModel.Gaussian.Information(information[rotation_first][:, rotation_first].numpy())
    for poses, measured in zip(T_wc, T_ij, strict=True):
        graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, T in enumerate(poses):
            start.insert(key, gtsam.Pose3(T.numpy()))
        graph.add(gtsam.NonlinearEqualityPose3(0, start.atPose3(0)))
        for (i, j), T in zip(edges.tolist(), measured, strict=True):
            graph.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(T.numpy()), noise))
        problems.append((graph, start))
    keys = range(T_wc.shape[1])

    def solve() -> Tensor:
        found = [gtsam.LevenbergMarquardtOptimizer(*problem).optimize() for problem in problems]
        return torch.from_numpy(np.stack([[each.atPose3(key).matrix() for key in keys] for each in found]))

    return solve


def theseus_poses(T_cw: Tensor, points: Tensor, uv: Tensor, K: Tensor, weights: Tensor) -> Solve:
    """Poses ``T_cw`` (B, 4, 4) from fixed points (B, N, 3), least squares of weighted pixels, one batch.

    The result has the gradient of the implicit function theorem if the weights (B, N) require one.
    """
    batch, count = points.shape[:2]
    focal, centre = K.diagonal()[:2], K[:2, 2]

    def residuals(optim_vars: Any, aux_vars: Any) -> Tensor:
        T, (X, pixels, root) = optim_vars[0].tensor, (each.tensor for each in aux_vars)
        in_camera = X.view(-1, count, 3) @ T[:, :, :3].mT + T[:, None, :, 3]
        projected = in_camera[..., :2] / in_camera[..., 2:] * focal + centre
        return ((projected - pixels.view(-1, count, 2)) * root[..., None]).flatten(1)

    variables = {"X": points.flatten(1), "pixels": uv.flatten(1), "root": weights.detach().sqrt()}
    given = [th.Variable(value.clone(), name=name) for name, value in variables.items()]
    pose = th.SE3(tensor=T_cw[:, :3].clone(), name="pose")
    unit = th.ScaleCostWeight(torch.ones(1, 1, dtype=torch.float64))
    objective = th.Objective(dtype=torch.float64)
    objective.add(th.AutoDiffCostFunction([pose], residuals, 2 * count, cost_weight=unit, aux_vars=given))
    solver = th.LevenbergMarquardt(objective, linear_solver_cls=th.CholeskyDenseSolver, max_iterations=10)
    layer = th.TheseusLayer(solver)

    def solve() -> Tensor:
        inputs = {"pose": T_cw[:, :3], **variables, "root": weights.sqrt()}
        found, _ = layer.forward(inputs, optimizer_kwargs={"backward_mode": "implicit"})
        last = T_cw.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(batch, 1, 4)
        return torch.cat([found["pose"], last], dim=1)

    return solve


def theseus_graphs(T_wc: Tensor, edges: Tensor, T_ij: Tensor, information: Tensor) -> Solve:
    """Pose graphs, the first pose of each fixed, one batch; poses ``T_wc`` (B, N, 4, 4)."""
    root = th.DiagonalCostWeight(information.diagonal().sqrt()[None])
    poses = [th.SE3(tensor=T[:, :3].clone(), name=f"pose{k}") for k, T in enumerate(T_wc.unbind(1))]
    objective = th.Objective(dtype=torch.float64)
    for k, ((i, j), T) in enumerate(zip(edges.tolist(), T_ij.unbind(1), strict=True)):
        measured = th.SE3(tensor=T[:, :3].clone(), name=f"edge{k}")
        objective.add(th.Between(poses[i], poses[j], measured, root, name=f"between{k}"))
    strong = th.ScaleCostWeight(torch.full((1, 1), 1e4, dtype=torch.float64))
    objective.add(th.Difference(poses[0], poses[0].copy(new_name="anchor"), strong, name="anchored"))
    solver = th.LevenbergMarquardt(objective, linear_solver_cls=th.CholeskyDenseSolver, max_iterations=20)
    layer, start = th.TheseusLayer(solver), {pose.name: pose.tensor.clone() for pose in poses}

    def solve() -> Tensor:
        with torch.no_grad():
            found, _ = layer.forward(start)
        last = T_wc.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*T_wc.shape[:2], 1, 4)
        return torch.cat([torch.stack([found[pose.name] for pose in poses], dim=1), last], dim=2)

    return solve


class _PyPoseGraph(torch.nn.Module):
    def __init__(self, T_wc: Tensor) -> None:
        super().__init__()
        self.first = pp.mat2SE3(T_wc[:1], check=False)
        self.others = pp.Parameter(pp.mat2SE3(T_wc[1:], check=False).clone())

    def forward(self, edges: Tensor, T_ij: Tensor) -> Tensor:
        poses = torch.cat([self.first, self.others])
        i, j = edges.unbind(1)
        return (T_ij.Inv() @ poses[i].Inv() @ poses[j]).Log().tensor()


def pypose_graphs(T_wc: Tensor, edges: Tensor, T_ij: Tensor, information: Tensor) -> Solve:
    """Pose graphs, the first pose of each fixed, one after the other; poses ``T_wc`` (B, N, 4, 4)."""

    def solve() -> Tensor:
        optimised = []
        for start, measured in zip(T_wc, T_ij, strict=True):
            graph, edge_poses = _PyPoseGraph(start), pp.mat2SE3(measured, check=False)
            solver = pp.optim.LM(graph, strategy=pp.optim.strategy.Adaptive(damping=1e-6))
            weight = information.expand(len(edges), 6, 6)
            schedule = pp.optim.scheduler.StopOnPlateau(solver, steps=20, patience=2, decreasing=1e-6)
            while schedule.continual():
                schedule.step(solver.step(input=(edges, edge_poses), weight=weight))
            optimised.append(torch.cat([graph.first, graph.others.detach()]).matrix())
        return torch.stack(optimised)

    return solve


def opencv_poses(T_cw: Tensor, points: Tensor, uv: Tensor, K: Tensor) -> Solve:
    """Poses ``T_cw`` (B, 4, 4) from fixed points (B, N, 3), least squares of pixels, one after the other."""
    arrays = [(X.numpy(), u.numpy(), K.numpy(), None) for X, u in zip(points, uv, strict=True)]
    starts = [(cv2.Rodrigues(T[:3, :3].numpy())[0], T[:3, 3:].numpy()) for T in T_cw]
    return lambda: to_poses([cv2.solvePnPRefineLM(*given, *s) for given, s in zip(arrays, starts, strict=True)])


def to_poses(motions: list[Any]) -> Tensor:
    """Poses of rotation vectors and translations, as OpenCV returns them, (B, 4, 4)."""
    T = torch.eye(4, dtype=torch.float64).repeat(len(motions), 1, 1)
    for k, (rotation, translation) in enumerate(motions):
        T[k, :3, :3] = torch.from_numpy(cv2.Rodrigues(rotation)[0])
        T[k, :3, 3] = torch.from_numpy(np.ravel(translation))
    return T
