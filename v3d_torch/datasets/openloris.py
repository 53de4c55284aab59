"""OpenLORIS-Scene (Shi et al., ICRA 2020), packages: images of a robot's D435i, ground truth of its base."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import cv2
import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.datasets.cameras import CameraChoice, checked_camera, choose_camera
from v3d_torch.datasets.lists import pair_lists
from v3d_torch.datasets.paired import PairedImages
from v3d_torch.errors import InputError
from v3d_torch.lie import invert, rigid
from v3d_torch.trajectory import read_trajectory
from v3d_torch.types import Trajectory

_COLOUR = "d400_color_optical_frame"
_BASE = "base_link"
_DEPTH_SCALE = 1000.0
"""The D435i's depth unit is a millimetre."""


class OpenLORISSequence(PairedImages):
    """Frames of a folder with ``color.txt``, ``aligned_depth.txt``, ``sensors.yaml`` and ``trans_matrix.yaml``.

    Args:
        folder: the sequence's folder.
        camera: the user's choice; None takes the one of ``sensors.yaml``.

    Raises:
        InputError: a file is missing or wrong.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        pairs = pair_lists(folder / "color.txt", folder / "aligned_depth.txt")
        own = None if camera is not None else _read_camera(folder / "sensors.yaml")
        truth = folder / "groundtruth.txt"
        super().__init__(
            folder,
            pairs,
            choose_camera(camera, folder, own),
            lambda: _camera_poses(truth, folder / "trans_matrix.yaml") if truth.is_file() else None,
        )


def is_openloris(path: Path) -> bool:
    """Whether a folder holds what the dataset's do; opening it tells what is missing."""
    return (path / "sensors.yaml").is_file() and (path / "color.txt").is_file()


def _read_camera(path: Path) -> PinholeCamera:
    storage = _open(path)  # its nodes live no longer than it does
    node = storage.getNode(_COLOUR)
    try:
        fx, cx, fy, cy = node.getNode("intrinsics").mat().reshape(4).tolist()  # in this order
        bent = node.getNode("distortion_coefficients")
        distortion = [] if bent.empty() else bent.mat().reshape(-1).tolist()
        width, height = (int(node.getNode(name).real()) for name in ("width", "height"))
    except (AttributeError, ValueError, cv2.error) as error:
        raise InputError(
            f"{path}: holds no {_COLOUR} with width, height, intrinsics; copy it again, or give --camera"
        ) from error
    fields = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height, "depth_scale": _DEPTH_SCALE}
    return checked_camera(fields | {"distortion": distortion + [0.0] * (5 - len(distortion))}, str(path))


def _camera_poses(truth: Path, calibration: Path) -> Trajectory:
    """Poses of the robot's base, in a file, to poses of its colour camera."""
    base = read_trajectory(truth)
    return Trajectory(base.stamps, base.T_wc @ _between(_BASE, _COLOUR, calibration))


def _between(parent: str, child: str, path: Path) -> Tensor:
    """``T_parent_child`` from a file of links of the robot, whichever links join the two."""
    found = {parent: torch.eye(4, dtype=torch.float64)}
    links = _read_links(path)
    queue = deque([parent])
    while queue:
        here = queue.popleft()
        for (a, b), T_ab in links.items():
            if here == a and b not in found:
                found[b] = found[a] @ T_ab
                queue.append(b)
    if child not in found:
        raise InputError(f"{path}: does not say where {child} is on {parent}, whose poses groundtruth.txt holds")
    return rigid(found[child])


def _read_links(path: Path) -> dict[tuple[str, str], Tensor]:
    """``T_ab`` by (a, b), both ways."""
    storage = _open(path)
    nodes = storage.getNode("trans_matrix")
    links: dict[tuple[str, str], Tensor] = {}
    try:
        for node in (nodes.at(i) for i in range(nodes.size())):
            parent, child = (node.getNode(name).string() for name in ("parent_frame", "child_frame"))
            T = torch.from_numpy(node.getNode("matrix").mat().reshape(4, 4)).to(torch.float64)
            links[parent, child] = T
            links[child, parent] = invert(T)
    except (AttributeError, ValueError, cv2.error) as error:
        raise InputError(f"{path}: a link has no parent_frame, child_frame or 4x4 matrix; copy it again") from error
    return links


def _open(path: Path) -> cv2.FileStorage:
    """A file in OpenCV's dialect of YAML, which YAML libraries refuse."""
    if not path.is_file():
        raise InputError(f"{path}: is not there, and nothing else says where the robot's camera is; copy it again")
    try:
        return cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:  # OpenCV raises the latter for text that it cannot parse
        raise InputError(f"{path}: is no YAML as OpenCV writes it; copy it again") from error
