"""OpenLORIS-Scene (Shi et al., ICRA 2020), package format: images of a robot's D435i and ground truth of its base."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.datasets.camera_fields import camera_from_fields
from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.groundtruth import GroundTruth
from v3d_torch.datasets.lists import pair_lists
from v3d_torch.datasets.matrix_files import opencv_matrix, read_opencv_yaml
from v3d_torch.datasets.paired_images import PairedImages
from v3d_torch.datasets.tum_trajectory import read_groundtruth
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_scale import MILLIMETRES
from v3d_torch.geometry.se3 import invert, orthonormalise
from v3d_torch.types import Trajectory

_COLOUR = "d400_color_optical_frame"
_BASE = "base_link"


class OpenLORISSequence(PairedImages):
    """Sequence with ``color.txt``, ``aligned_depth.txt``, ``sensors.yaml`` and ``trans_matrix.yaml``.

    Args:
        folder: Folder of the sequence.
        camera: Camera chosen by the user; None for the ``camera.yaml`` or ``K.txt`` in the folder, else the camera in
            ``sensors.yaml``.

    Raises:
        InputError: If a file is missing or invalid.
    """

    def __init__(self, folder: Path, camera: CameraChoice = None) -> None:
        pairs, note = pair_lists(folder / "color.txt", folder / "aligned_depth.txt")
        groundtruth = folder / "groundtruth.txt"
        super().__init__(
            folder,
            pairs,
            camera,
            lambda: _camera_poses(groundtruth, folder / "trans_matrix.yaml") if groundtruth.is_file() else None,
            published=lambda: _read_camera(folder / "sensors.yaml"),
            depth_scale=MILLIMETRES,
            pairing_note=note,
        )


def is_openloris(path: Path) -> bool:
    """Check whether a folder contains the main files of the dataset. Opening the sequence reports missing ones."""
    return (path / "sensors.yaml").is_file() and (path / "color.txt").is_file()


def _read_camera(path: Path) -> PinholeCamera:
    try:
        node = read_opencv_yaml(path)[_COLOUR]
        fx, cx, fy, cy = opencv_matrix(node["intrinsics"], 4).tolist()  # the dataset's order
        fields = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": node["width"], "height": node["height"]}
        lens = node.get("distortion_coefficients", {"data": []})
        distortion = opencv_matrix(lens, len(lens["data"])).tolist()
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: has no {_COLOUR} with width, height and intrinsics; copy it again, or pass --camera"
        ) from error
    fields |= {"distortion": distortion, "distortion_model": "plumb_bob", "depth_scale": MILLIMETRES}
    return camera_from_fields(fields, str(path))


def _camera_poses(groundtruth: Path, calibration: Path) -> GroundTruth:
    """Read the poses of the robot's base and convert them to poses of its colour camera."""
    T_base_camera = _find_transform(_BASE, _COLOUR, calibration)
    return read_groundtruth(groundtruth).convert(lambda base: Trajectory(base.stamps, base.T_wc @ T_base_camera))


def _find_transform(parent: str, child: str, path: Path) -> Tensor:
    """Compute ``T_parent_child`` by a breadth-first search through the transforms of a calibration file."""
    found = {parent: torch.eye(4, dtype=torch.float64)}
    transforms = _read_transforms(path)
    queue = deque([parent])
    while queue:
        current = queue.popleft()
        for (a, b), T_ab in transforms.items():
            if current == a and b not in found:
                found[b] = found[a] @ T_ab
                queue.append(b)
    if child not in found:
        raise InputError(
            f"{path}: has no transform from {child} to {parent}, the frame of groundtruth.txt; copy it again"
        )
    return orthonormalise(found[child])


def _read_transforms(path: Path) -> dict[tuple[str, str], Tensor]:
    """Read the transforms ``T_ab`` of a calibration file by (a, b), in both directions."""
    transforms: dict[tuple[str, str], Tensor] = {}
    try:
        for node in read_opencv_yaml(path).get("trans_matrix", []):
            parent, child = str(node["parent_frame"]), str(node["child_frame"])
            T = torch.from_numpy(opencv_matrix(node["matrix"], 4, 4))
            transforms[parent, child] = T
            transforms[child, parent] = invert(T)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: a transform has no parent_frame, child_frame or 4x4 matrix; copy it again"
        ) from error
    return transforms
