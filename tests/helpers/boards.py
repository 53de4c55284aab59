"""Boards that move in front of a wall: their depth, instances and tracks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v3d_torch.config import CloudConfig, TrackerConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.instance_clouds import InstanceBackProjector
from v3d_torch.objects.instance_tracker import InstanceTracker
from v3d_torch.objects.track import Track
from v3d_torch.types import Instances

CAMERA = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120)
CLOUDS = CloudConfig(stride=1)  # a quarter of the usual resolution
WALL = 4.0
HERE = torch.eye(4, dtype=torch.float64)
PERSON, CHAIR, DOG = 0, 56, 16


@dataclass(frozen=True)
class Board:
    """Board parallel to the image of a camera at the origin: centre and size, world frame, metres."""

    x: float
    z: float = 2.0
    y: float = 0.0
    width: float = 0.4
    height: float = 0.8
    label: int = PERSON
    detected: bool = True  # by the network; the depth image always shows the board


def render(boards: list[Board], T_wc: Tensor = HERE) -> tuple[Tensor, Instances]:
    """Return depth (1, H, W) and the instances in the order of the boards, for a camera that does not turn."""
    o = T_wc[:3, 3]
    depth = torch.full((CAMERA.height, CAMERA.width), WALL - float(o[2]))
    owner = torch.full(depth.shape, -1)
    for i, board in enumerate(boards):
        z = board.z - float(o[2])
        point = CAMERA.rays.double() * z + o
        inside = (point[..., 0] - board.x).abs() <= board.width / 2
        inside &= ((point[..., 1] - board.y).abs() <= board.height / 2) & (depth > z)
        depth[inside], owner[inside] = z, i
    detected = [i for i, board in enumerate(boards) if board.detected and bool((owner == i).any())]
    if not detected:
        return depth[None], Instances.empty(CAMERA.height, CAMERA.width)
    labels = torch.tensor([boards[i].label for i in detected])
    return depth[None], Instances(
        torch.stack([owner == i for i in detected]), labels, torch.ones(len(detected)), torch.zeros(len(detected), 4)
    )


def render_turned(boards: list[Board], T_wc: Tensor) -> tuple[Tensor, Instances]:
    """Same as `render`, for a camera at the origin that has turned around the vertical axis."""
    direction = CAMERA.rays.double() @ T_wc[:3, :3].T  # of unit depth in the camera frame
    depth, owner = WALL / direction[..., 2], torch.full((CAMERA.height, CAMERA.width), -1)
    for i, board in enumerate(boards):
        point = direction * (board.z / direction[..., 2:])
        inside = ((point[..., 0] - board.x).abs() <= board.width / 2) & (point[..., 1].abs() <= board.height / 2)
        depth[inside], owner[inside] = (board.z / direction[..., 2])[inside], i
    masks = torch.stack([owner == i for i in range(len(boards))])
    labels = torch.tensor([board.label for board in boards])
    return depth.float()[None], Instances(masks, labels, torch.ones(len(boards)), torch.zeros(len(boards), 4))


class BoardTracker:
    """Tracker that processes one set of boards after another."""

    def __init__(self, rate: float = 30.0, **config: float | bool) -> None:
        self.rate = rate
        self.frame = -1
        self.tracker = InstanceTracker(TrackerConfig(**config), CAMERA, CLOUDS)
        self._back_project = InstanceBackProjector(CLOUDS, CAMERA)

    def __call__(self, *boards: Board, T_wc: Tensor = HERE, stamp: float | None = None) -> list[Track]:
        self.frame += 1
        stamp = self.frame / self.rate if stamp is None else stamp
        return self.track(*render(list(boards), T_wc), stamp, T_wc=T_wc)

    def track(
        self,
        depth: Tensor,
        instances: Instances,
        stamp: float,
        *,
        T_wc: Tensor = HERE,
        appearance: Tensor | None = None,
    ) -> list[Track]:
        """Process a depth image with its instances."""
        clouds = self._back_project(depth, instances)
        return self.tracker(stamp, instances, clouds, depth, T_wc, appearance)
