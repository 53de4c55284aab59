"""PLY files, read back with another library."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from v3d_torch.errors import InputError, OutputError
from v3d_torch.io.ply import read_ply_points, write_ply


def columns(element: plyfile.PlyElement, *names: str) -> np.ndarray:
    return np.stack([element[name] for name in names], axis=1)


def test_all_elements_are_read_back(tmp_path: Path) -> None:
    points = torch.randn(5, 3, dtype=torch.float64)
    colours = torch.randint(0, 256, (5, 3), dtype=torch.uint8)
    normals = torch.randn(5, 3)
    faces, edges = torch.tensor([[0, 1, 2], [2, 3, 4]]), torch.tensor([[0, 4], [1, 3], [2, 2]])
    write_ply(tmp_path / "all.ply", points, colours, normals=normals, faces=faces, edges=edges)
    ply = plyfile.PlyData.read(tmp_path / "all.ply")
    assert not ply.text and ply.byte_order == "<"
    vertex = ply["vertex"]
    np.testing.assert_array_equal(columns(vertex, "x", "y", "z"), points.float().numpy())
    np.testing.assert_array_equal(columns(vertex, "nx", "ny", "nz"), normals.numpy())
    np.testing.assert_array_equal(columns(vertex, "red", "green", "blue"), colours.numpy())
    np.testing.assert_array_equal(np.stack(ply["face"]["vertex_indices"]), faces.numpy())
    np.testing.assert_array_equal(columns(ply["edge"], "vertex1", "vertex2"), edges.numpy())
    ply.write(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "all.ply").read_bytes()


def test_optional_elements_are_omitted(tmp_path: Path) -> None:
    write_ply(tmp_path / "points.ply", torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    ply = plyfile.PlyData.read(tmp_path / "points.ply")
    assert [element.name for element in ply] == ["vertex"] and ply["vertex"].count == 0
    assert [field.name for field in ply["vertex"].properties] == ["x", "y", "z", "red", "green", "blue"]


@pytest.mark.parametrize("count", [0, 7])
def test_points_are_read_from_a_written_file(count: int, tmp_path: Path) -> None:
    points, normals = torch.randn(count, 3), torch.randn(count, 3)
    colours = torch.randint(0, 256, (count, 3), dtype=torch.uint8)
    write_ply(tmp_path / "map.ply", points, colours, normals=normals)
    read = read_ply_points(tmp_path / "map.ply")
    assert torch.equal(read[0], points) and torch.equal(read[1], colours)


def test_points_are_read_from_a_file_with_faces(tmp_path: Path) -> None:
    points, colours = torch.randn(3, 3), torch.zeros(3, 3, dtype=torch.uint8)
    write_ply(tmp_path / "mesh.ply", points, colours, faces=torch.tensor([[0, 1, 2]]))
    assert torch.equal(read_ply_points(tmp_path / "mesh.ply")[0], points)


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-1], lambda b: b[:40], lambda b: b.replace(b" x", b" w"), lambda b: b""]
)
def test_damaged_point_map_is_error(damage: Callable[[bytes], bytes], tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, torch.randn(3, 3), torch.zeros(3, 3, dtype=torch.uint8))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=r"map\.ply: is damaged or not a point map of a run; run the sequence again"):
        read_ply_points(path)


def test_output_error_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"map\.ply: cannot be written"):
        write_ply(tmp_path / "file" / "map.ply", torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8))
