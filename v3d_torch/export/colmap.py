"""Sparse model of COLMAP as text, with images and masks (Schoenberger and Frahm, CVPR 2016)."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.export.landmark_tracks import LandmarkTracks
from v3d_torch.export.posed_image import CORNER_OFFSET, PosedImage
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.io.files import write_text

_CAMERA_ID = 1

_MAX_POINTS = 200_000
"""Maximum number of points of the dense map that are written; a larger map is subsampled."""


def write_colmap(
    folder: Path,
    camera: PinholeCamera,
    images: Iterable[PosedImage],
    points: tuple[Tensor, Tensor],
    tracks: LandmarkTracks,
) -> None:
    """Write ``images/``, ``masks/`` and the model ``sparse/0``: ``cameras.txt``, ``images.txt``, ``points3D.txt``.

    Masks have the names that COLMAP expects: the name of the image with ``.png`` appended. Image points on masked
    pixels, which can be people, are left out. A landmark that then has fewer than two image points is left out, too.

    Args:
        folder: Empty folder.
        camera: Camera of the images.
        images: Images.
        points: Points of the static map without image points: positions, world frame, metres, and RGB, uint8, shape
            :math:`(N, 3)` each.
        tracks: Landmarks with their observations in the images.

    Raises:
        OutputError: If a file cannot be written.
    """
    model = folder / "sparse" / "0"
    tracks = replace(tracks, uv=camera.distort(tracks.uv))
    colours = torch.zeros(len(tracks.points), 3, dtype=torch.uint8)
    is_static = torch.zeros(len(tracks.uv), dtype=torch.bool)
    # Features beside the border of a recorded image can be outside of the undistorted one.
    is_inside = ((tracks.uv >= -0.5) & (tracks.uv <= torch.tensor([camera.width, camera.height]) - 0.5)).all(dim=1)
    image_lines, poses = [], []
    for index, image in enumerate(images):
        image.write_colour(folder / "images")
        image.write_mask(folder / "masks" / f"{image.name}.png")
        observed = torch.nonzero((tracks.image == index) & is_inside)[:, 0]
        observed = observed[_values_at(image.static, tracks.uv[observed])]
        is_static[observed] = True
        colours[tracks.landmark[observed]] = _values_at(image.frame.image, tracks.uv[observed]).T
        image_lines.append(_image_line(index, image))
        poses.append(invert(image.T_wc)[None])
    tracks = tracks.select(is_static)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then X, Y, POINT3D_ID of each point"]
    for index, line in enumerate(image_lines):
        observed = tracks.image == index
        lines += [line, _observation_line(tracks.uv[observed], tracks.landmark[observed])]
    write_text(model / "cameras.txt", f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS\n{_camera_line(camera)}\n")
    write_text(model / "images.txt", "\n".join(lines) + "\n")
    T_cw = torch.cat([torch.zeros(0, 4, 4, dtype=torch.float64), *poses])
    write_text(
        model / "points3D.txt",
        "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, then IMAGE_ID, POINT2D_IDX of each observation\n"
        + _landmark_lines(tracks, colours, _reprojection_errors(camera, tracks, T_cw))
        + _point_lines(*points, first_id=len(tracks.points) + 1),
    )


def _camera_line(camera: PinholeCamera) -> str:
    """Return the camera with the model of COLMAP that has the fewest parameters."""
    coefficients = camera.distortion
    if not camera.is_distorted:
        model, coefficients = "PINHOLE", ()
    elif camera.distortion_model == "equidistant":
        model = "OPENCV_FISHEYE"
    elif not any(coefficients[4:]):
        model, coefficients = "OPENCV", coefficients[:4]
    else:
        model, coefficients = "FULL_OPENCV", (*coefficients, 0.0, 0.0, 0.0)[:8]
    parameters = (camera.fx, camera.fy, camera.cx + CORNER_OFFSET, camera.cy + CORNER_OFFSET, *coefficients)
    return f"{_CAMERA_ID} {model} {camera.width} {camera.height} {' '.join(map(repr, parameters))}"


def _image_line(index: int, image: PosedImage) -> str:
    T_cw = invert(image.T_wc)
    quaternion = Rotation.from_matrix(T_cw[:3, :3].numpy()).as_quat(canonical=True, scalar_first=True)
    values = np.concatenate([quaternion, T_cw[:3, 3].numpy()]) + 0.0  # + 0.0: no "-0"
    pose = " ".join(f"{value:.12g}" for value in values.tolist())
    return f"{index + 1} {pose} {_CAMERA_ID} {image.name}"


def _observation_line(uv: Tensor, landmark: Tensor) -> str:
    return " ".join(
        f"{u:.4f} {v:.4f} {row + 1}"
        for (u, v), row in zip((uv + CORNER_OFFSET).tolist(), landmark.tolist(), strict=True)
    )


def _values_at(image: Tensor, uv: Tensor) -> Tensor:
    """Return the values of an image (..., H, W) at the nearest pixels, shape (..., N)."""
    u, v = uv.round().long().unbind(dim=1)
    return image[..., v.clamp(0, image.shape[-2] - 1), u.clamp(0, image.shape[-1] - 1)]


def _reprojection_errors(camera: PinholeCamera, tracks: LandmarkTracks, T_cw: Tensor) -> Tensor:
    """Return the mean distance of each landmark from its distorted image points, pixels, float64, shape (L,)."""
    T, points = T_cw[tracks.image], tracks.points[tracks.landmark]
    projected = camera.project((T[:, :3, :3] @ points[:, :, None])[..., 0] + T[:, :3, 3])
    distances = (camera.distort(projected) - tracks.uv).norm(dim=1)
    sums, counts = torch.zeros(2, len(tracks.points), dtype=torch.float64)
    sums.index_add_(0, tracks.landmark, distances)
    counts.index_add_(0, tracks.landmark, torch.ones_like(distances))
    return sums / counts


def _landmark_lines(tracks: LandmarkTracks, colours: Tensor, errors: Tensor) -> str:
    """Return a line per landmark that has image points, with them."""
    counts = torch.bincount(tracks.image)
    position = torch.arange(len(tracks.image)) - (counts.cumsum(dim=0) - counts)[tracks.image]
    observations: list[list[str]] = [[] for _ in range(len(tracks.points))]
    for landmark, image, index in zip(tracks.landmark.tolist(), tracks.image.tolist(), position.tolist(), strict=True):
        observations[landmark].append(f"{image + 1} {index}")
    rows = zip(tracks.points.tolist(), colours.tolist(), errors.tolist(), observations, strict=True)
    return "".join(
        f"{row} {x:.6f} {y:.6f} {z:.6f} {red} {green} {blue} {error:.4f} {' '.join(track)}\n"
        for row, ((x, y, z), (red, green, blue), error, track) in enumerate(rows, start=1)
        if track
    )


def _point_lines(points: Tensor, colours: Tensor, first_id: int) -> str:
    """Return a line per point, without image points."""
    step = -(-len(points) // _MAX_POINTS) or 1
    kept = torch.cat([points[::step].double(), colours[::step].double()], dim=1)
    ids = torch.arange(first_id, first_id + len(kept), dtype=torch.float64)[:, None]
    text = io.StringIO()
    np.savetxt(text, torch.cat([ids, kept], dim=1).numpy(), fmt="%d %.6f %.6f %.6f %d %d %d 0")
    return text.getvalue()
