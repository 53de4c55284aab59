"""Readers of COLMAP's text models: one of the documented format, with OpenCV's cameras, and pycolmap."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

_PYCOLMAP = """
import json, sys
import numpy as np
import pycolmap

model = pycolmap.Reconstruction(sys.argv[1])
queries = np.array(json.loads(sys.stdin.read()))
images = {
    image.name: {
        "T_cw": image.cam_from_world().matrix().tolist(),
        "points": [[*point.xy, point.point3D_id if point.has_point3D() else 0] for point in image.points2D],
        "projections": [None if (uv := image.project_point(query)) is None else uv.tolist() for query in queries],
    }
    for image in model.images.values()
}
(camera,) = model.cameras.values()
points = {
    number: {
        "xyz": point.xyz.tolist(),
        "color": point.color.tolist(),
        "error": point.error,
        "track": [[model.images[element.image_id].name, element.point2D_idx] for element in point.track.elements],
    }
    for number, point in model.points3D.items()
}
print(json.dumps({"camera": [camera.model.name, *camera.params], "images": images, "points": points}))
"""

_EMPTY = np.zeros((0, 3))


@dataclass(frozen=True)
class ColmapModel:
    """Model of COLMAP.

    Attributes:
        camera: Name of the camera model, and its parameters.
        images: Pose (3, 4), image points (x, y, id of the point or 0), and projections of the queries, by name.
        points: Position, colour, error and observations (name of the image, index of the image point), by id.
    """

    camera: list[Any]
    images: dict[str, dict[str, Any]]
    points: dict[int, dict[str, Any]]


def read_model(folder: Path, queries: NDArray[np.float64] = _EMPTY) -> ColmapModel:
    """Read a model as COLMAP documents its format, and project world points (N, 3) into all its images."""
    ((_, name, _, _, *numbers),) = _rows(folder / "cameras.txt")
    parameters = [float(number) for number in numbers]
    lines = (folder / "images.txt").read_text().splitlines()
    lines = [line for line in lines if not line.startswith("#")]
    names, images = {}, {}
    for pose, observations in zip(lines[::2], lines[1::2], strict=True):
        number, *values, _, file = pose.split()
        quaternion, translation = np.array(values[:4], float), np.array(values[4:], float)
        R_cw = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        seen = np.array(observations.split(), float).reshape(-1, 3)
        names[number] = file
        images[file] = {
            "T_cw": np.column_stack([R_cw, translation]).tolist(),
            "points": [[x, y, int(point)] for x, y, point in seen.tolist()],
            "projections": _project(name, parameters, queries @ R_cw.T + translation),
        }
    points = {
        int(number): {
            "xyz": [float(x), float(y), float(z)],
            "color": [int(red), int(green), int(blue)],
            "error": float(error),
            "track": [[names[image], int(index)] for image, index in zip(track[::2], track[1::2], strict=True)],
        }
        for number, x, y, z, red, green, blue, error, *track in _rows(folder / "points3D.txt")
    }
    return ColmapModel([name, *parameters], images, points)


def read_with_pycolmap(folder: Path, queries: NDArray[np.float64] = _EMPTY) -> ColmapModel:
    """Read a model with pycolmap, in another process: its libraries cannot share a process with those of OpenCV."""
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", _PYCOLMAP, str(folder)],
        input=json.dumps(queries.tolist()),
        capture_output=True,
        text=True,
        check=True,
    )
    tree = json.loads(done.stdout.splitlines()[-1])
    return ColmapModel(tree["camera"], tree["images"], {int(key): value for key, value in tree["points"].items()})


def _rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def _project(model: str, parameters: list[float], points: NDArray[np.float64]) -> list[NDArray[np.float64] | None]:
    """Project points in the camera frame; None for points behind the camera."""
    fx, fy, cx, cy, *distortion = parameters
    K, none = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    if not len(points):
        return []
    if model == "OPENCV_FISHEYE":
        uv = cv2.fisheye.projectPoints(points[:, None], none, none, K, np.array(distortion))[0]
    else:
        uv = cv2.projectPoints(points, none, none, K, np.array(distortion or [0.0] * 4))[0]
    return [pixel if z > 0 else None for pixel, z in zip(uv.reshape(-1, 2), points[:, 2], strict=True)]
