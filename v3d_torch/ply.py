"""Points, meshes and line sets as binary PLY files, which MeshLab, CloudCompare, Blender and Open3D open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile
from torch import Tensor

from v3d_torch.files import written_whole


def write_ply(
    path: Path,
    points: Tensor,
    colours: Tensor,
    *,
    normals: Tensor | None = None,
    faces: Tensor | None = None,
    edges: Tensor | None = None,
) -> None:
    """Write coloured vertices, and what joins them.

    Args:
        path: of the file.
        points: metres, shape :math:`(N, 3)`, written in float32.
        colours: RGB, uint8, shape :math:`(N, 3)`.
        normals: unit vectors, shape :math:`(N, 3)`.
        faces: triangles of vertices, shape :math:`(F, 3)`.
        edges: lines between vertices, shape :math:`(E, 2)`.

    Raises:
        OutputError: when the file cannot be written.
    """
    named = [(("x", "y", "z"), "f4", points)]
    named += [] if normals is None else [(("nx", "ny", "nz"), "f4", normals)]
    named += [(("red", "green", "blue"), "u1", colours)]
    vertices = np.empty(len(points), dtype=[(name, kind) for names, kind, _ in named for name in names])
    for names, _, columns in named:
        for name, column in zip(names, columns.numpy().T, strict=True):
            vertices[name] = column
    elements = [plyfile.PlyElement.describe(vertices, "vertex")]
    if faces is not None:
        triangles = np.empty(len(faces), dtype=[("vertex_indices", "i4", (3,))])
        triangles["vertex_indices"] = faces.numpy()
        elements.append(plyfile.PlyElement.describe(triangles, "face"))
    if edges is not None:
        lines = np.empty(len(edges), dtype=[("vertex1", "i4"), ("vertex2", "i4")])
        lines["vertex1"], lines["vertex2"] = edges.numpy().T
        elements.append(plyfile.PlyElement.describe(lines, "edge"))
    with written_whole(path) as temporary:
        plyfile.PlyData(elements).write(temporary)
