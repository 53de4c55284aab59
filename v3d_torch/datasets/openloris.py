"""OpenLORIS-Scene (Shi et al., ICRA 2020), packages: images of a robot's D435i, ground truth of its base."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.datasets.cameras import CameraChoice, checked_camera, choose_camera
from v3d_torch.datasets.lists import pair_lists
from v3d_torch.datasets.opencv_yaml import matrix, read_opencv_yaml
from v3d_torch.datasets.paired import PairedImages
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert, rigid
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
    try:
        node = read_opencv_yaml(path)[_COLOUR]
        fx, cx, fy, cy = matrix(node["intrinsics"], 4).tolist()  # in this order
        fields = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": node["width"], "height": node["height"]}
        lens = node.get("distortion_coefficients", {"data": []})
        distortion = matrix(lens, len(lens["data"])).tolist()
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: holds no {_COLOUR} with width, height, intrinsics; copy it again, or give --camera"
        ) from error
    fields |= {"distortion": distortion + [0.0] * (5 - len(distortion)), "depth_scale": _DEPTH_SCALE}
    return checked_camera(fields, str(path))


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
    links: dict[tuple[str, str], Tensor] = {}
    try:
        for node in read_opencv_yaml(path).get("trans_matrix", []):
            parent, child = str(node["parent_frame"]), str(node["child_frame"])
            T = torch.from_numpy(matrix(node["matrix"], 4, 4))
            links[parent, child] = T
            links[child, parent] = invert(T)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: a link has no parent_frame, child_frame or 4x4 matrix; copy it again") from error
    return links
