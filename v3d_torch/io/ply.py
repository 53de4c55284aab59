"""Points, meshes and line sets as binary PLY files, which MeshLab, CloudCompare, Blender and Open3D open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.io.files import atomic_write


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
    named = [(("x", "y", "z"), "<f4", points)]
    named += [] if normals is None else [(("nx", "ny", "nz"), "<f4", normals)]
    named += [(("red", "green", "blue"), "u1", colours)]
    vertices = np.empty(len(points), dtype=[(name, kind) for names, kind, _ in named for name in names])
    for names, _, columns in named:
        for name, column in zip(names, columns.numpy().T, strict=True):
            vertices[name] = column
    elements = {"vertex": vertices}
    if faces is not None:
        elements["face"] = triangles = np.empty(len(faces), dtype=[(_CORNERS, "u1"), ("vertex_indices", "<i4", 3)])
        triangles[_CORNERS], triangles["vertex_indices"] = 3, faces.numpy()
    if edges is not None:
        elements["edge"] = lines = np.empty(len(edges), dtype=[("vertex1", "<i4"), ("vertex2", "<i4")])
        lines["vertex1"], lines["vertex2"] = edges.numpy().T
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(_header(elements).encode("ascii"))
        for rows in elements.values():
            file.write(rows.tobytes())


_CORNERS = "corners"
"""How many vertices a face has, which stands before them in the file."""

_TYPES = {"f4": "float", "u1": "uchar", "i4": "int"}
"""Names of number types in PLY."""


def _header(elements: dict[str, NDArray[np.void]]) -> str:
    """What the rows that follow are: an element with a property per column, or a list of vertices."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for element, rows in elements.items():
        names = rows.dtype.names or ()
        lines.append(f"element {element} {len(rows)}")
        for name in names:
            if name != _CORNERS:
                several = "list uchar " if _CORNERS in names else ""
                lines.append(f"property {several}{_TYPES[rows.dtype[name].base.str[1:]]} {name}")
    return "\n".join([*lines, "end_header", ""])
