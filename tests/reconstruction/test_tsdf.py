"""TSDF of known surfaces, and the mesh of a known room, also compared with Open3D if it is installed."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np
import pytest
import torch
from helpers.box_room import CAMERA, CRATE, EYE, ROOM, distance_to, keyframe, looking_around, render
from scipy.spatial import KDTree
from torch import Tensor

from v3d_torch.config import DenseMapConfig, MeshConfig
from v3d_torch.geometry.se3 import invert
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.reconstruction import mesh as mesh_module
from v3d_torch.reconstruction.mesh import Mesh, fuse_mesh
from v3d_torch.reconstruction.tsdf import BLOCK, integrate, surface_blocks

ALL = torch.ones(240, 320, dtype=torch.bool)
CONFIG = DenseMapConfig()
VOXEL, TRUNCATION = CONFIG.mesh.voxel_size, CONFIG.mesh.truncation


def views_of(poses: Tensor, *boxes: Tensor, stride: int = 2) -> StaticViews:
    """Views of the room from poses T_wc; colours are linear in the position, from black to white corner."""
    views = StaticViews(CAMERA, stride)
    for T_wc in poses:
        depth = render(T_wc, *boxes)
        points = (CAMERA.rays * depth[0, ..., None]).double() @ T_wc[:3, :3].T + T_wc[:3, 3]
        colour = 255 * ((points - ROOM[0]) / (ROOM[1] - ROOM[0])).clamp(0, 1)
        views.add(keyframe(invert(T_wc)), colour.round().to(torch.uint8).permute(2, 0, 1), depth, ALL)
    return views


def flat(z: float, *more: tuple[Tensor, float]) -> StaticViews:
    """Views of flat walls: one at depth z from the origin, and others from poses T_cw at given depths."""
    views = StaticViews(CAMERA, 1)
    for T_cw, distance in ((EYE, z), *more):
        grey = torch.full((3, 240, 320), 128, dtype=torch.uint8)
        views.add(keyframe(T_cw), grey, torch.full((1, 240, 320), distance), ALL)
    return views


@pytest.fixture(scope="module")
def room() -> Mesh:
    """Mesh of the room with a crate in it from twelve poses."""
    return fuse_mesh(views_of(looking_around(12), CRATE), CONFIG)


# --- distances


def test_blocks_cover_the_surface_and_its_truncation_band_only() -> None:
    views = flat(2.0)
    blocks = surface_blocks(views, CONFIG)
    assert torch.equal(blocks, blocks.unique(dim=0))
    side = BLOCK * VOXEL
    depths = (blocks[:, 2] * side).unique()
    assert torch.equal(depths, depths[(depths <= 2.0 + TRUNCATION) & (depths + side >= 2.0 - TRUNCATION)])
    edge = torch.tensor([[0.0, 0], [319, 239]]).sub(torch.tensor([CAMERA.cx, CAMERA.cy])) / CAMERA.fx * 2.0
    expected = (edge / side).floor()
    assert torch.equal(blocks[blocks[:, 2] == 12][:, :2].amin(dim=0), expected[0].long())
    assert torch.equal(blocks[blocks[:, 2] == 12][:, :2].amax(dim=0), expected[1].long())
    far = surface_blocks(flat(4.5), CONFIG)
    assert len(far) == 0  # beyond max_depth


def test_blocks_smaller_than_the_truncation_distance_are_covered_without_gaps() -> None:
    """Only those at the surface and at both ends of the band were found, and the mesh had holes."""
    config = DenseMapConfig(stride=1, mesh=MeshConfig(voxel_size=0.005, truncation=0.08))
    blocks = surface_blocks(flat(2.01), config)
    for column in ([0, 0], [-3, 5], [7, -2]):  # near the optical axis, where rays are nearly parallel to it
        found = blocks[(blocks[:, :2] == torch.tensor(column)).all(dim=1)]
        assert found[:, 2].tolist() == [48, 49, 50, 51, 52]  # of 4 cm, from 1.93 m to 2.09 m


def test_convention_distances_are_along_the_optical_axis_and_positive_in_front_of_the_surface() -> None:
    blocks = torch.tensor([[0, 0, 12], [0, 0, 5], [0, 0, 14], [0, 0, -12]])
    distances, weights = integrate(blocks, flat(2.0), CONFIG)
    z = (blocks[:, 2:] * BLOCK + torch.arange(BLOCK)) * VOXEL  # (4, 8)
    expected = ((2.0 - z) / TRUNCATION).float()
    known = (expected > -1) & (z > 0)
    expected = torch.where(known, expected.clamp(max=1), 1.0)[:, None, None].expand(4, BLOCK, BLOCK, BLOCK)
    torch.testing.assert_close(distances, expected, rtol=0, atol=1e-4)
    assert torch.equal(weights > 0, known[:, None, None].expand(4, BLOCK, BLOCK, BLOCK))
    torch.testing.assert_close(weights[0, 0, 0, :3], 1 / z[0, :3].square().float(), rtol=1e-4, atol=0)


def test_voxels_outside_of_the_image_have_no_weight() -> None:
    blocks = torch.cartesian_prod(torch.arange(-20, 20), torch.arange(-20, 20), torch.tensor([11]))
    _, weights = integrate(blocks, flat(2.0), CONFIG)
    voxels = (blocks[:, None] * BLOCK + torch.cartesian_prod(*3 * [torch.arange(BLOCK)])) * VOXEL
    uv = CAMERA.project(voxels.double())
    inside = ((uv > -0.499) & (uv < torch.tensor([319.499, 239.499]))).all(dim=-1)
    outside = ((uv < -0.501) | (uv > torch.tensor([319.501, 239.501]))).any(dim=-1)
    assert (weights.flatten(1)[inside] > 0).all() and (weights.flatten(1)[outside] == 0).all()
    assert inside.any() and outside.any()


def test_distances_are_means_weighted_by_inverse_squared_depth() -> None:
    """Two walls 4 cm apart, the second one viewed from half a metre farther away."""
    back = torch.eye(4, dtype=torch.float64)
    back[2, 3] = 0.5
    distances, weights = integrate(torch.tensor([[0, 0, 12]]), flat(2.0, (back, 2.54)), CONFIG)
    z = (12 * BLOCK + torch.arange(BLOCK)) * VOXEL
    first, second = ((2.0 - z) / TRUNCATION).clamp(max=1), ((2.04 - z) / TRUNCATION).clamp(max=1)
    a, b = 1 / z.square(), 1 / (z + 0.5).square()
    torch.testing.assert_close(weights[0, 0, 0], a + b, rtol=1e-4, atol=0)
    torch.testing.assert_close(distances[0, 0, 0], (a * first + b * second) / (a + b), rtol=0, atol=1e-3)


def test_object_in_observed_free_space_leaves_no_surface() -> None:
    views = StaticViews(CAMERA, 1)
    person = torch.full((1, 240, 320), 2.5)
    person[0, 100:140, 140:180] = 1.5
    grey = torch.full((3, 240, 320), 128, dtype=torch.uint8)
    for depth in (person, *3 * [torch.full((1, 240, 320), 2.5)]):
        views.add(keyframe(EYE), grey, depth, ALL)
    mesh = fuse_mesh(views, CONFIG)
    assert len(mesh.vertices) > 1000 and mesh.vertices[:, 2].min() > 2.4


# --- the mesh


def test_vertices_that_no_view_observes_have_the_colour_of_their_neighbours() -> None:
    """The silhouettes of a crate before a wall: triangles are observed at their centres, some vertices are not."""
    mesh = fuse_mesh(views_of(looking_around(3), CRATE), CONFIG)
    expected = 255 * ((mesh.vertices.double() - ROOM[0]) / (ROOM[1] - ROOM[0])).clamp(0, 1)
    dark = (mesh.colours == 0).all(dim=1) & (expected > 20).any(dim=1)
    assert dark.sum() <= 1 and len(mesh.vertices) > 10_000


def test_vertices_lie_on_the_surfaces_of_the_room(room: Mesh) -> None:
    assert len(room.vertices) > 20_000
    error = distance_to(room.vertices.double(), CRATE)
    assert error.median() < 0.05 * VOXEL
    # Corners are rounded, and behind the edges of the crate its depth was not observed.
    assert error.quantile(0.95) < 0.5 * VOXEL and error.quantile(0.99) < TRUNCATION


def test_mesh_covers_all_visible_surfaces(room: Mesh) -> None:
    for T_wc in looking_around(12)[::3]:
        points = (CAMERA.rays * render(T_wc, CRATE)[0, ..., None])[::16, ::16].reshape(-1, 3).double()
        points = points @ T_wc[:3, :3].T + T_wc[:3, 3]
        covered = torch.cdist(points, room.vertices.double()).amin(dim=1) < 1.5 * VOXEL
        assert covered.double().mean() > 0.97


def test_convention_triangles_are_counterclockwise_from_free_space(room: Mesh) -> None:
    """Viewed from inside the room; vertex normals agree."""
    a, b, c = room.vertices[room.faces].double().unbind(dim=1)
    normal = torch.linalg.cross(b - a, c - a)
    on_walls = (distance_to((a + b + c) / 3) < 0.01) & (normal.norm(dim=1) > 1e-6)
    inward = -((a + b + c) / 3 * normal).sum(dim=1)
    assert (inward[on_walls] > 0).double().mean() > 0.995
    assert (torch.nn.functional.normalize(normal, dim=1) * room.normals[room.faces[:, 0]]).sum(dim=1).median() > 0.99
    lengths = room.normals.norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths))


def test_vertex_colours_equal_the_colours_of_the_views(room: Mesh) -> None:
    near = distance_to(room.vertices.double(), CRATE) < 0.2 * VOXEL
    expected = 255 * ((room.vertices - ROOM[0]) / (ROOM[1] - ROOM[0])).clamp(0, 1)
    difference = (room.colours.double() - expected).abs().amax(dim=1)[near]
    assert difference.quantile(0.95) < 4  # of 255: a pixel is 1 cm wide


def test_colour_of_an_object_in_front_of_a_surface_is_not_that_of_the_surface() -> None:
    """A red panel covers the whole wall in another view."""
    views = flat(2.0)
    red = torch.tensor([255, 0, 0], dtype=torch.uint8)[:, None, None].expand(3, 240, 320)
    views.add(keyframe(frame=1), red, torch.ones(1, 240, 320), ALL)
    mesh = fuse_mesh(views, CONFIG)
    wall = mesh.vertices[:, 2] > 1.9
    assert wall.sum() > 1000 and (mesh.colours[wall] == 128).all()


def test_mesh_is_closed_except_at_its_boundary() -> None:
    """Each inner edge has a triangle on both sides, also between tiles."""
    mesh = fuse_mesh(views_of(looking_around(12)), CONFIG)
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, times = edges.sort(dim=1).values.unique(dim=0, return_counts=True)
    assert times.max() == 2
    boundary = edges.sort(dim=1).values.unique(dim=0)[times == 1]
    # Floor and ceiling are observed in the corners only: the boundary is above and below.
    assert (mesh.vertices[boundary][..., 1].abs() > 0.5).all()
    assert len(mesh.faces.unique()) == len(mesh.vertices)


def test_views_that_disagree_leave_no_layer_behind_the_surface() -> None:
    """A wall that two views measure 12 cm apart: between its two surfaces was one that faced away from both views."""
    mesh = fuse_mesh(flat(2.0, (EYE, 2.12)), CONFIG)
    torch.testing.assert_close(mesh.vertices[:, 2].unique(), torch.tensor([2.06, 2.12]), atol=1e-3, rtol=0)
    a, b, c = mesh.vertices[mesh.faces].unbind(dim=1)
    assert (torch.linalg.cross(b - a, c - a)[:, 2] < 0).all()
    assert (mesh.normals[:, 2] < 0).all() and (mesh.colours == 128).all()
    assert len(mesh.faces.unique()) == len(mesh.vertices)


def test_mesh_is_equal_for_any_tile_size(monkeypatch: pytest.MonkeyPatch) -> None:
    views = views_of(looking_around(3), CRATE)
    whole = fuse_mesh(views, CONFIG)
    monkeypatch.setattr(mesh_module, "_TILE", 3)
    tiled = fuse_mesh(views, CONFIG)
    assert len(tiled.vertices) == len(whole.vertices) and len(tiled.faces) == len(whole.faces)
    nearest, same = KDTree(whole.vertices.double().numpy()).query(tiled.vertices.double().numpy())
    assert nearest.max() < 1e-5
    assert (tiled.colours.int() - whole.colours[same].int()).abs().max() <= 1


def test_smaller_voxels_give_a_finer_mesh() -> None:
    views = views_of(looking_around(6), stride=1)
    fine = fuse_mesh(views, DenseMapConfig(stride=1, mesh=MeshConfig(voxel_size=0.01, truncation=0.04)))
    coarse = fuse_mesh(views, DenseMapConfig(stride=1, mesh=MeshConfig(voxel_size=0.04, truncation=0.16)))
    assert 12 < len(fine.vertices) / len(coarse.vertices) < 30
    assert distance_to(fine.vertices.double()).quantile(0.95) < 0.002


def test_mesh_without_views_or_static_pixels_is_empty() -> None:
    views = StaticViews(CAMERA, 2)
    for _ in range(2):
        mesh = fuse_mesh(views, CONFIG)
        assert mesh.vertices.shape == mesh.normals.shape == mesh.colours.shape == mesh.faces.shape == (0, 3)
        views.add(keyframe(), torch.zeros(3, 240, 320, dtype=torch.uint8), torch.ones(1, 240, 320), ~ALL)


def test_mesh_is_deterministic(room: Mesh) -> None:
    again = fuse_mesh(views_of(looking_around(12), CRATE), CONFIG)
    for name in ("vertices", "faces", "normals", "colours"):
        assert torch.equal(getattr(again, name), getattr(room, name))


# --- Open3D


def open3d() -> ModuleType:
    try:
        return importlib.import_module("open3d")
    except ImportError as error:  # not installed, or without a system library such as libusb-1.0
        pytest.skip(f"Open3D cannot be imported: {error}")


def test_mesh_equals_the_mesh_of_open3d() -> None:
    """Open3D's dense volume with the same voxels; its scalable volume of version 0.20 stays empty."""
    o3d = open3d()
    poses = looking_around(12)
    kind = o3d.pipelines.integration.TSDFVolumeColorType.NoColor
    volume = o3d.pipelines.integration.UniformTSDFVolume(
        length=4.0, resolution=round(4.0 / VOXEL), sdf_trunc=TRUNCATION, color_type=kind, origin=np.full(3, -2.004)
    )
    intrinsic = o3d.camera.PinholeCameraIntrinsic(
        CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
    )
    for T_wc in poses:
        depth = o3d.geometry.Image(np.ascontiguousarray(render(T_wc, CRATE)[0].numpy()))
        colour = o3d.geometry.Image(np.full((240, 320, 3), 128, dtype=np.uint8))
        image = o3d.geometry.RGBDImage.create_from_color_and_depth(
            colour, depth, depth_scale=1.0, depth_trunc=4.0, convert_rgb_to_intensity=False
        )
        volume.integrate(image, intrinsic, invert(T_wc).numpy())
    theirs = torch.from_numpy(np.asarray(volume.extract_triangle_mesh().vertices).copy())
    ours = fuse_mesh(views_of(poses, CRATE, stride=1), CONFIG).vertices.double()
    assert 0.98 < len(ours) / len(theirs) < 1.02
    for a, b in ((ours, theirs), (theirs, ours)):
        nearest = torch.from_numpy(
            KDTree(b.numpy()).query(a[::9].numpy())[0]
        )  # of vertices: the two grids have different origins
        assert nearest.quantile(0.98) < 0.75 * VOXEL
    errors = [distance_to(mesh, CRATE).quantile(0.99) for mesh in (ours, theirs)]
    assert errors[0] < 1.1 * errors[1], errors
