"""Model of COLMAP, read by pycolmap in another process: its libraries cannot share a process with those of OpenCV."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_READ = """
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


@dataclass(frozen=True)
class ColmapModel:
    """Model as COLMAP understands it.

    Attributes:
        camera: Name of the camera model, and its parameters.
        images: Pose (3, 4), image points (x, y, id of the point or 0), and projections of the queries, by name.
        points: Position, colour, error and observations (name of the image, index of the image point), by id.
    """

    camera: list[Any]
    images: dict[str, dict[str, Any]]
    points: dict[int, dict[str, Any]]


def read_model(folder: Path, queries: NDArray[np.float64] | None = None) -> ColmapModel:
    """Read a model, and project world points (N, 3) into all its images with COLMAP's camera models."""
    points = np.zeros((0, 3)) if queries is None else queries
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", _READ, str(folder)],
        input=json.dumps(points.tolist()),
        capture_output=True,
        text=True,
        check=True,
    )
    tree = json.loads(done.stdout.splitlines()[-1])
    return ColmapModel(tree["camera"], tree["images"], {int(key): value for key, value in tree["points"].items()})
