"""Inputs of the camera modules: padded batches of views, maps and graphs with little noise.

Each function takes the batch size, the number of elements and the dtype. The second problem of a batch has no valid
elements.
"""

from __future__ import annotations

import torch
from torch import Tensor

from helpers.random_numbers import RandomNumbers
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, se3_exp

CAMERA = PinholeCamera(fx=500.0, fy=510.0, cx=319.5, cy=239.5)
POSES, LANDMARKS = 3, 6

Inputs = dict[str, Tensor]


class _Random(RandomNumbers):
    """Random numbers that depend on their order and the batch size only."""

    def __init__(self, batch: int, count: int) -> None:
        super().__init__(seed=0)
        self.shape = batch, count

    def mask(self) -> Tensor:
        """Mask of about three quarters of the elements."""
        valid = self.uniform(*self.shape) < 0.75
        valid[1:2] = False
        return valid


def cast(inputs: Inputs, dtype: torch.dtype) -> Inputs:
    """Convert the floating-point inputs to another dtype."""
    return {name: each.to(dtype) if each.is_floating_point() else each for name, each in inputs.items()}


def _K(batch: int) -> Tensor:
    return CAMERA.K.repeat(batch, 1, 1)


def _points(random: _Random, batch: int, count: int) -> tuple[Tensor, Tensor]:
    """Pixels and the points there in the camera frame."""
    uv = random.uniform(batch, count, 2) * torch.tensor([600.0, 440.0], dtype=torch.float64) + 20
    return uv, CAMERA.back_project(uv, 1 + 3 * random.uniform(batch, count))


def _transform(T: Tensor, points: Tensor) -> Tensor:
    return points @ T[..., :3, :3].mT + T[..., None, :3, 3]


def view(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Landmarks measured by cameras, some without depth, and predicted poses."""
    random = _Random(batch, count)
    T_cw = se3_exp(0.3 * random.normal(batch, 6))
    uv, in_camera = _points(random, batch, count)
    inverse_depth = 1 / in_camera[..., 2] + 0.005 * random.normal(batch, count)
    inputs = {
        "T_cw": se3_exp(0.01 * random.normal(batch, 6)) @ T_cw,
        "points": _transform(invert(T_cw), in_camera),
        "uv": uv + 0.3 * random.normal(batch, count, 2),
        "K": _K(batch),
        "inverse_depth": inverse_depth * (random.uniform(batch, count) < 0.7),
        "weights": 0.5 + random.uniform(batch, count),
        "valid": random.mask(),
    }
    return cast(inputs, dtype)


def points_in_view(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    inputs = view(batch, count, dtype)
    return {name: inputs[name] for name in ("points", "uv", "K", "valid")}


def two_views(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Pixels of points in two images."""
    random = _Random(batch, count)
    uv, points = _points(random, batch, count)
    step = torch.tensor([0.3, -0.1, 0.2, 0.0, 0.0, 0.0], dtype=torch.float64)
    moved = _transform(se3_exp(step + 0.05 * random.normal(batch, 6)), points)
    noise = 0.2 * random.normal(batch, count, 2)
    return cast({"uv_a": uv, "uv_b": CAMERA.project(moved) + noise, "K": _K(batch), "valid": random.mask()}, dtype)


def descriptors(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Descriptors that differ in few bits, in another order; the dtype is not used."""
    random = _Random(batch, count)
    a = (256 * random.uniform(batch, count, 32)).to(torch.uint8)
    flips = (random.uniform(batch, count, 32) < 0.5).to(torch.uint8)
    order = random.uniform(batch, count).argsort(dim=1)
    b = (a ^ flips).gather(1, order[..., None].expand_as(a))
    return {"a": a, "b": b, "a_valid": random.mask(), "b_valid": random.mask()}


def bundle(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Observations of landmarks by several poses, and inaccurate poses and landmarks; the first pose is true."""
    random = _Random(batch, count)
    T_cw = se3_exp(0.1 * random.normal(batch, POSES, 6))
    points = _points(random, batch, LANDMARKS)[1]
    pose = torch.arange(count).expand(batch, count) % POSES
    point = torch.arange(count).expand(batch, count) // POSES % LANDMARKS
    rows = torch.arange(batch)[:, None]
    in_camera = (T_cw[rows, pose, :3, :3] @ points[rows, point, :, None])[..., 0] + T_cw[rows, pose, :3, 3]
    inverse_depth = 1 / in_camera[..., 2] + 0.005 * random.normal(batch, count)
    error = 0.01 * random.normal(batch, POSES, 6)
    error[:, 0] = 0
    inputs = {
        "T_cw": se3_exp(error) @ T_cw,
        "points": points + 0.02 * random.normal(batch, LANDMARKS, 3),
        "uv": CAMERA.project(in_camera) + 0.3 * random.normal(batch, count, 2),
        "pose": pose.clone(),
        "point": point.clone(),
        "K": _K(batch),
        "inverse_depth": inverse_depth,
        "weights": 0.5 + random.uniform(batch, count),
        "valid": random.mask(),
    }
    return cast(inputs, dtype)


def calibration(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """A bundle and the derivatives of its pixels by the readout."""
    random = _Random(batch, count)
    seconds, information = torch.full((batch,), 0.02), torch.full((batch,), 2500.0)
    jacobian = 30 * random.normal(batch, count, 2)
    inputs = {"seconds": seconds, "information": information, "readout_jacobian": jacobian}
    return cast(inputs, dtype) | bundle(batch, count, dtype)


def graph(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Edges between the poses of a ring, with noise, and inaccurate initial poses; the first one is true."""
    random = _Random(batch, count)
    T_wc = se3_exp(0.5 * random.normal(batch, POSES + 2, 6))
    start = torch.arange(count) % (POSES + 2)
    edges = torch.stack([start, (start + 1 + torch.arange(count) // (POSES + 2) % 2) % (POSES + 2)], dim=-1)
    i, j = edges.unbind(-1)
    T_ij = invert(T_wc[:, i]) @ T_wc[:, j] @ se3_exp(0.02 * random.normal(batch, count, 6))
    error = 0.1 * random.normal(batch, POSES + 2, 6)
    error[:, 0] = 0
    factor = 0.3 * random.normal(batch, count, 6, 6)
    inputs = {
        "T_wc": T_wc @ se3_exp(error),
        "edges": edges.repeat(batch, 1, 1),
        "T_ij": T_ij,
        "information": 1e3 * (torch.eye(6, dtype=torch.float64) + factor @ factor.mT),
        "weights": 0.5 + random.uniform(batch, count),
        "valid": random.mask(),
    }
    return cast(inputs, dtype)


def rolling(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Pixels of a moving rolling-shutter camera."""
    random = _Random(batch, count)
    uv, points = _points(random, batch, count)
    inputs = {
        "uv": uv,
        "row": uv[..., 1].round(),
        "inverse_depth": 1 / points[..., 2],
        "velocity": random.normal(batch, 6),
        "K": _K(batch),
        "readout_jacobian": random.normal(batch, count, 2),
        "valid": random.mask(),
    }
    return cast(inputs, dtype)


def trajectories(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Ground truths and noisy estimates in another world frame, one pose per second."""
    random = _Random(batch, count)
    steps = 0.1 * random.normal(batch, count, 6)
    T_gc = se3_exp(steps.cumsum(dim=1))
    T_ec = se3_exp(random.normal(batch, 1, 6)) @ T_gc @ se3_exp(0.02 * random.normal(batch, count, 6))
    stamps = torch.arange(count, dtype=torch.float32).repeat(batch, 1)
    return cast({"T_gc": T_gc, "T_ec": T_ec, "stamps": stamps, "valid": random.mask()}, dtype)


def positions(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Trajectories without their timestamps."""
    inputs = trajectories(batch, count, dtype)
    return {name: inputs[name] for name in ("T_gc", "T_ec", "valid")}


def correspondences(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Noisy points in two frames."""
    random = _Random(batch, count)
    p = random.normal(batch, count, 3)
    q = _transform(se3_exp(random.normal(batch, 6)), p) + 0.01 * random.normal(batch, count, 3)
    return cast({"p": p, "q": q, "weights": 0.5 + random.uniform(batch, count), "valid": random.mask()}, dtype)


def twists(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Tangent vectors of rigid motions."""
    return cast({"xi": _Random(batch, count).normal(batch, count, 6)}, dtype)


def motions(batch: int, count: int, dtype: torch.dtype) -> Inputs:
    """Rigid motions."""
    return cast({"T": se3_exp(_Random(batch, count).normal(batch, count, 6))}, dtype)
