"""Point clouds, meshes and line sets as binary PLY files, for MeshLab, CloudCompare, Blender and Open3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.io.files import atomic_write

_CORNER_COUNT = "corner_count"
"""Field of the number of corners, which a PLY list stores before the vertex indices of a face."""

_PLY_TYPES = {"f4": "float", "u1": "uchar", "i4": "int"}
"""PLY name of each NumPy type."""

_DTYPES = {name: f"<{numpy_type}" for numpy_type, name in _PLY_TYPES.items()}
"""NumPy type of each PLY name."""


def write_ply(
    path: Path,
    points: Tensor,
    colours: Tensor,
    *,
    normals: Tensor | None = None,
    faces: Tensor | None = None,
    edges: Tensor | None = None,
) -> None:
    """Write coloured vertices, and optionally faces and edges between them, atomically.

    Args:
        path: File to write.
        points: Positions of the vertices, metres, shape :math:`(N, 3)`; written as float32.
        colours: RGB of the vertices, uint8, shape :math:`(N, 3)`.
        normals: Unit normals of the vertices, shape :math:`(N, 3)`.
        faces: Vertex indices of the triangles, shape :math:`(F, 3)`.
        edges: Vertex indices of the lines, shape :math:`(E, 2)`.

    Raises:
        OutputError: If the file cannot be written.
    """
    groups = [(("x", "y", "z"), "<f4", points)]
    groups += [] if normals is None else [(("nx", "ny", "nz"), "<f4", normals)]
    groups += [(("red", "green", "blue"), "u1", colours)]
    vertices = np.empty(len(points), dtype=[(name, dtype) for names, dtype, _ in groups for name in names])
    for names, _, values in groups:
        for name, column in zip(names, values.numpy().T, strict=True):
            vertices[name] = column
    elements = {"vertex": vertices}
    if faces is not None:
        triangles = np.empty(len(faces), dtype=[(_CORNER_COUNT, "u1"), ("vertex_indices", "<i4", 3)])
        triangles[_CORNER_COUNT], triangles["vertex_indices"] = 3, faces.numpy()
        elements["face"] = triangles
    if edges is not None:
        lines = np.empty(len(edges), dtype=[("vertex1", "<i4"), ("vertex2", "<i4")])
        lines["vertex1"], lines["vertex2"] = edges.numpy().T
        elements["edge"] = lines
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(_header(elements).encode("ascii"))
        for rows in elements.values():
            file.write(rows.tobytes())


def read_ply_points(path: Path) -> tuple[Tensor, Tensor]:
    """Read the vertices of a file that `write_ply` wrote.

    Args:
        path: File to read.

    Returns:
        Positions, metres, float32, shape :math:`(N, 3)`, and RGB, uint8, shape :math:`(N, 3)`.

    Raises:
        InputError: If the file cannot be read or was not written by `write_ply`.
    """
    try:
        header, _, content = path.read_bytes().partition(b"end_header\n")
        first, count, fields = None, 0, []
        for line in header.decode("ascii").splitlines():
            match line.split():
                case ["element", name, number] if first in (None, name):
                    first, count = name, int(number)
                case ["element", *_]:
                    break
                case ["property", kind, name]:
                    fields.append((name, _DTYPES[kind]))
        rows = np.frombuffer(content, dtype=fields, count=count)
        points, colours = (
            np.stack([rows[name] for name in names], axis=1) for names in (("x", "y", "z"), ("red", "green", "blue"))
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); run the sequence again") from error
    except (ValueError, KeyError, TypeError) as error:  # of wrong or missing bytes
        raise InputError(f"{path}: is damaged or not a point map of a run; run the sequence again") from error
    return torch.from_numpy(points), torch.from_numpy(colours)


def _header(elements: dict[str, NDArray[np.void]]) -> str:
    """Return the PLY header: each element with one property per field, or with one list of vertices."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for element, rows in elements.items():
        names = rows.dtype.names or ()
        lines.append(f"element {element} {len(rows)}")
        list_type = "list uchar " if _CORNER_COUNT in names else ""
        types = {name: _PLY_TYPES[rows.dtype[name].base.str[1:]] for name in names if name != _CORNER_COUNT}
        lines += [f"property {list_type}{ply_type} {name}" for name, ply_type in types.items()]
    return "\n".join([*lines, "end_header", ""])
