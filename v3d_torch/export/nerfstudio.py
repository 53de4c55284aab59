"""Folder that nerfstudio reads: ``transforms.json`` with images, masks and depth images (Tancik et al., 2023)."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from v3d_torch.errors import ConfigError
from v3d_torch.export.posed_image import CORNER_OFFSET, PosedImage
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import SATURATED_DEPTH, depth_to_units
from v3d_torch.io.files import atomic_write, write_png, write_text
from v3d_torch.io.ply import read_ply_points

_LOG = logging.getLogger(__name__)

_MILLIMETRES = 1000
"""Units of the depth images per metre: nerfstudio's default."""

_OPENGL_AXES = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
"""Signs of the camera's axes in OpenGL: x right, y up, z backwards."""


def write_nerfstudio(folder: Path, camera: PinholeCamera, images: Iterable[PosedImage], points: Path) -> None:
    """Write a folder for nerfstudio: ``images/``, ``masks/``, ``depths/``, ``points.ply`` and ``transforms.json``.

    Depth beyond 65.53 m, the 16-bit range of millimetres, is written as 0, no measurement, with a warning in the log.

    Args:
        folder: Empty folder.
        camera: Camera of the images.
        images: Images.
        points: PLY file with the static map, which is copied.

    Raises:
        InputError: If the PLY file was not written by a run, or is damaged.
        ConfigError: If nerfstudio does not have the distortion model of the camera, ``rational_polynomial``.
        OutputError: If a file cannot be written.
    """
    lens = _lens(camera)
    read_ply_points(points)  # an error before the images are written
    written = [_write_frame(folder, image) for image in images]
    if out_of_range := sum(count for _, count in written):
        _LOG.warning(
            "%s: %d depth values beyond %.4g m were saved as 0; depth images for nerfstudio are 16-bit millimetres",
            folder, out_of_range, (SATURATED_DEPTH - 1) / _MILLIMETRES,
        )  # fmt: skip
    with atomic_write(folder / "points.ply") as temporary:
        shutil.copyfile(points, temporary)
    transforms = {
        **lens,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + CORNER_OFFSET,
        "cy": camera.cy + CORNER_OFFSET,
        "depth_unit_scale_factor": 1 / _MILLIMETRES,
        "ply_file_path": "points.ply",
        "frames": [entry for entry, _ in written],
    }
    write_text(folder / "transforms.json", json.dumps(transforms, indent=1) + "\n")


def _lens(camera: PinholeCamera) -> dict[str, Any]:
    """Return the camera model of nerfstudio and its distortion coefficients."""
    if not camera.is_distorted or camera.distortion_model == "plumb_bob":
        return {"camera_model": "OPENCV", **dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False))}
    if camera.distortion_model == "equidistant":
        return {"camera_model": "OPENCV_FISHEYE", **dict(zip(("k1", "k2", "k3", "k4"), camera.distortion, strict=True))}
    raise ConfigError(
        f"nerfstudio has no distortion model {camera.distortion_model}; remove the distortion with --undistort"
    )


def opengl_pose(T_wc: Tensor) -> Tensor:
    """Return the pose of a camera whose axes are x right, y up, z backwards, float64, shape :math:`(4, 4)`.

    Args:
        T_wc: Camera-to-world pose, float64, shape :math:`(4, 4)`.
    """
    return T_wc * _OPENGL_AXES


def _write_frame(folder: Path, image: PosedImage) -> tuple[dict[str, Any], int]:
    """Write the images of a frame; return its entry and the number of pixels whose depth is out of range."""
    image.write_colour(folder / "images")
    units, out_of_range = depth_to_units(image.static_depth, _MILLIMETRES)
    write_png(folder / "depths" / image.name, units)
    image.write_mask(folder / "masks" / image.name)
    entry = {
        "file_path": f"images/{image.name}",
        "mask_path": f"masks/{image.name}",
        "depth_file_path": f"depths/{image.name}",
        "transform_matrix": opengl_pose(image.T_wc).tolist(),
    }
    return entry, out_of_range
