"""The built-in sequence: the same bytes, exact poses, a sensor's errors, people who move as they should."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from v3d_torch.datasets import demo
from v3d_torch.datasets.cameras import load_camera
from v3d_torch.datasets.demo import materials
from v3d_torch.datasets.demo.geometry import Box, Figure, Pose, Rectangle, Scene
from v3d_torch.datasets.demo.lighting import bake
from v3d_torch.datasets.demo.path import camera_pose
from v3d_torch.datasets.demo.people import WALK_SPEED, sway, walk
from v3d_torch.datasets.demo.render import Renderer, Rendering
from v3d_torch.datasets.demo.room import build_room
from v3d_torch.datasets.demo.sensor import FARTHEST, grazing, projector_shadow, sense_depth
from v3d_torch.datasets.demo.sequence import CAMERA, FRAMES, RATE, SEED, write_sequence
from v3d_torch.datasets.demo.texturing import TextureTable
from v3d_torch.errors import OutputError
from v3d_torch.geometry.camera import PinholeCamera

SMALL = PinholeCamera(fx=131.25, fy=131.25, cx=79.5, cy=59.5, width=160, height=120, readout=0.0)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(build_room(SEED), SMALL)


def rendered(renderer: Renderer, time: float) -> Rendering:
    return renderer(camera_pose(time), time)


def world_points(depth: Tensor, T_wc: np.ndarray, camera: PinholeCamera = SMALL) -> np.ndarray:
    points = (camera.rays * depth[..., None]).double().numpy()
    return points @ T_wc[:3, :3].T + T_wc[:3, 3]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    write_sequence(folder, range(0, 80, 40))
    return folder


def test_same_bytes_again_with_more_threads_and_another_selection(sequence: Path, tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        write_sequence(tmp_path, range(40, 41))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    first, second = contents(sequence), contents(tmp_path)
    images = [name for name in second if name.endswith((".png", ".jpg"))]
    assert len(images) == 3
    assert all(first[name] == second[name] for name in images)


def test_layout(sequence: Path) -> None:
    camera = load_camera(sequence / "camera.yaml")
    assert camera == CAMERA and camera.distortion == (0.0,) * 5 and camera.depth_scale == 5000 and camera.readout == 0
    lines = (sequence / "associations.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["1.000000", "2.333333"]
    for line in lines:
        _, colour, stamp, depth = line.split()
        assert cv2.imread(str(sequence / colour)).shape == (480, 640, 3)
        image = cv2.imread(str(sequence / depth), cv2.IMREAD_UNCHANGED)
        assert image.shape == (480, 640) and image.dtype == np.uint16
        mask = cv2.imread(str(sequence / "masks" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.shape == (480, 640) and set(np.unique(mask)) <= {0, 1, 2}


def test_convention_ground_truth_is_camera_to_world(sequence: Path) -> None:
    """Pixels of the floor-parallel counter lift to its height, which only T_wc of a camera looking along +z does."""
    truth = np.loadtxt(sequence / "groundtruth.txt")
    depth = cv2.imread(str(sequence / "depth" / "1.000000.png"), cv2.IMREAD_UNCHANGED) / 5000.0
    T_wc = np.eye(4)
    T_wc[:3, :3] = Rotation.from_quat(truth[0, 4:]).as_matrix()
    T_wc[:3, 3] = truth[0, 1:4]
    points = world_points(torch.from_numpy(depth), T_wc, CAMERA)[440:, 250:350][depth[440:, 250:350] > 0]
    assert np.median(points[:, 2]) == pytest.approx(0.90, abs=0.003)
    assert np.allclose(T_wc, camera_pose(0.0), atol=1e-8)


def test_one_pose_explains_another_frame(renderer: Renderer) -> None:
    """Static points of one frame, moved by the poses, lie on the surfaces of the other."""
    (one, T_1), (two, T_2) = ((rendered(renderer, t), camera_pose(t)) for t in (0.3, 0.8))
    points = world_points(one.depth, T_1)[one.mover.numpy() == 0]
    seen = (points - T_2[:3, 3]) @ T_2[:3, :3]
    uv = SMALL.project(torch.from_numpy(seen)).round().long()
    inside = (uv >= 0).all(1) & (uv < torch.tensor([160, 120])).all(1)
    u, v = uv[inside].T
    error = (two.depth[v, u].numpy() - seen[inside.numpy(), 2])[two.mover[v, u].numpy() == 0]
    assert abs(np.median(error)) < 1e-3
    assert np.percentile(np.abs(error), 80) < 0.03  # the nearest pixel, not the exact one


def test_depth_of_a_slanted_plane_is_exact() -> None:
    """Against the closed form: the ray meets the plane z = 2 + x / 2."""
    texture = np.full((8, 8, 3), 0.5, np.float32)
    # World axes chosen as the camera's own (x right, y down, z forward).
    plane = Rectangle((-4.0, -4.0, 0.0), (8.0, 0.0, 4.0), (0.0, 8.0, 0.0), texture)
    scene = Scene([plane], [])
    depth = Renderer(scene, SMALL)(np.eye(4), 0.0).depth
    expected = 2.0 / (1.0 - SMALL.rays[..., 0] / 2.0)
    assert torch.allclose(depth, expected, rtol=2e-5)


def test_the_nearest_surface_hides_the_others() -> None:
    rectangles = [
        Rectangle((-5.0, -5.0, z), (10.0, 0, 0), (0, 10.0, 0), np.full((8, 8, 3), shade, np.float32))
        for z, shade in ((3.0, 0.2), (2.0, 0.6), (4.0, 0.9))
    ]
    result = Renderer(Scene(rectangles, []), SMALL)(np.eye(4), 0.0)
    assert torch.allclose(result.depth, torch.tensor(2.0))
    assert torch.allclose(result.colour, torch.tensor(0.6), atol=1e-6)


def test_texture_lookup_equals_grid_sample() -> None:
    """At full resolution, against torch's own bilinear interpolation."""
    rng = np.random.default_rng(0)
    textures = [rng.random((37, 53, 3), np.float32), rng.random((16, 90, 3), np.float32)]
    s, t = torch.rand(2, 500, generator=torch.Generator().manual_seed(1))
    surface = torch.arange(500, dtype=torch.int32) % 2
    found = TextureTable(textures, [100.0, 100.0])(surface, s, t, torch.full((500,), 0.01))
    grid = torch.stack([2 * s - 1, 2 * t - 1], -1)[None, None]
    for i, texture in enumerate(textures):
        image = torch.from_numpy(texture).permute(2, 0, 1)[None]
        oracle = torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=False)[0, :, 0].T
        assert torch.allclose(found[surface == i], oracle[surface == i], atol=2e-3)


def test_a_distant_texture_is_averaged() -> None:
    checker = np.indices((64, 64)).sum(0)[..., None] % 2 * np.ones(3, np.float32)
    colour = TextureTable([checker.astype(np.float32)], [64.0])(
        torch.zeros(9, dtype=torch.int32), torch.rand(9), torch.rand(9), torch.full((9,), 0.1)
    )
    assert torch.allclose(colour, torch.tensor(0.5), atol=1e-5)


def test_a_box_casts_a_shadow() -> None:
    floor = Rectangle((-2.0, 4.0, 0.0), (4.0, 0, 0), (0, -4.0, 0), np.ones((64, 64, 3), np.float32))
    room = ((-2.0, 0.0, 0.0), (2.0, 4.0, 2.7))
    table = Box((-0.5, 1.5, 0.4), (0.5, 2.5, 0.5))
    dark = bake([floor], [table], *room, seed=0)[0].texture
    light = bake([floor], [Box((9.0, 9.0, 9.0), (9.1, 9.1, 9.1))], *room, seed=0)[0].texture
    assert dark[32, 32, 0] < 0.8 * light[32, 32, 0]
    assert dark[2, 2, 0] == pytest.approx(light[2, 2, 0], rel=0.02)


def test_depth_noise_grows_with_the_square_of_depth() -> None:
    """Khoshelham and Elberink: about 1.4e-3 z^2 metres, and steps of the disparity."""
    for z in (1.0, 2.0, 3.0, 4.0):
        depth = z * (1.0 + 0.02 * torch.linspace(-1, 1, 640).expand(480, 640))  # over many steps
        measured = sense_depth(depth, CAMERA, torch.Generator().manual_seed(3))
        error = (measured - depth)[measured > 0]
        assert float(error.std()) == pytest.approx(1.4e-3 * z**2, rel=0.05)
        assert abs(float(error.mean())) < 0.5e-3 * z**2
    # 1 / z takes few values: integers over f b * 8.
    steps = CAMERA.fx * 0.075 * 8 / measured[measured > 0]
    assert torch.allclose(steps, steps.round(), atol=2e-3)


def test_depth_has_holes_where_a_kinect_has_them() -> None:
    depth = torch.full((480, 640), 3.0)
    depth[100:380, 200:400] = 1.5
    shadow = projector_shadow(depth, CAMERA)
    width = CAMERA.fx * 0.075 * (1 / 1.5 - 1 / 3.0)  # disparity between the surfaces: 13 pixels
    assert shadow[240].sum() == pytest.approx(width, abs=2.5)
    assert shadow[240, 200 - int(width) + 3 : 200].all() and not shadow[50].any()
    depth[:, 600:] = FARTHEST + 0.1
    measured = sense_depth(depth, CAMERA, torch.Generator().manual_seed(0))
    assert (measured[:, 602:] == 0).all()
    assert 0.85 < float((measured > 0).float().mean()) < 0.95


@pytest.mark.parametrize(("degrees", "lost"), [(70.0, False), (79.0, False), (81.0, True), (87.0, True)])
def test_grazing_surfaces_are_lost(degrees: float, lost: bool) -> None:
    """The ray through the principal point meets the plane at the given angle from its normal."""
    slope = np.tan(np.radians(degrees))
    inverse = 1.0 - CAMERA.rays[..., 0] * slope
    middle = grazing(1.0 / inverse.clamp(min=0.1), CAMERA)[240, 318:322]
    assert bool(middle.all()) is lost and bool(middle.any()) is lost


def visible_centroid(renderer: Renderer, time: float, mover: int) -> np.ndarray:
    result = rendered(renderer, time)
    return world_points(result.depth, camera_pose(time))[result.mover.numpy() == mover].mean(0)


def test_walker_moves_and_swayer_stays(renderer: Renderer) -> None:
    """The walker advances as said; the swayer's centroid stays within 2 cm while the silhouette changes."""
    walked = visible_centroid(renderer, 2.6, 1) - visible_centroid(renderer, 2.3, 1)
    assert walked[0] == pytest.approx(0.3 * WALK_SPEED, abs=0.03)
    times = np.arange(0.0, 1.1, 0.1)
    centroids = np.stack([visible_centroid(renderer, t, 2) for t in times])
    assert (centroids.std(axis=0) < 0.012).all() and (np.abs(centroids - centroids.mean(0)) < 0.03).all()
    leans = [abs(sway(t).lean) for t in times]
    assert max(leans) * 0.5 > 0.10  # metres at the head, half a metre above the pivot


def test_masks_are_where_something_changed(renderer: Renderer) -> None:
    """From one pose at two times, pixels of colour that change are in the mask of either time, and only there."""
    T_wc = camera_pose(2.0)
    one, two = renderer(T_wc, 2.0), renderer(T_wc, 2.1)
    changed = (one.colour - two.colour).abs().amax(-1) > 0.02
    moving = (one.mover > 0) | (two.mover > 0)
    ring = torch.nn.functional.max_pool2d(moving[None].float(), 3, 1, 1)[0] > 0  # antialiased edges
    assert not (changed & ~ring).any()
    assert float((changed & moving).sum() / moving.sum()) > 0.5
    assert {1, 2} <= set(one.mover.unique().tolist())


def test_a_figure_leans_about_its_pivot() -> None:
    """Where the alpha's edge lies in the image, against the geometry: upper edge moves, pivot's row does not."""
    rgba = np.ones((100, 50, 4), np.float32)
    wall = Rectangle((-5, 4.0, 5.0), (10.0, 0, 0), (0, 0, -10.0), np.zeros((8, 8, 3), np.float32))
    figure = Figure(rgba, (0.0, 2.0, -0.5), 1.0, 0.001, mover=7, pivot=(0.5, 0.5))
    T_wc = np.eye(4)
    T_wc[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    columns = []
    for lean in (0.0, 0.4):
        moved = replace(figure, motion=lambda t, lean=lean: Pose(lean=lean))
        mover = Renderer(Scene([wall], [moved]), SMALL)(T_wc, 0.0).mover
        columns.append([float(torch.nonzero(mover[row] == 7).float().mean()) for row in (30, 59, 88)])
    top, middle, bottom = np.subtract(columns[1], columns[0])
    expected = 0.4 * 29.5 / SMALL.fy * 2.0 * SMALL.fx / 2.0
    assert top == pytest.approx(expected, abs=1.0) and bottom == pytest.approx(-expected, abs=1.0)
    assert middle == pytest.approx(0.0, abs=0.6)


def test_camera_path_is_a_hand_held_one() -> None:
    poses = np.stack([camera_pose(i / RATE) for i in range(FRAMES)])
    assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert (np.ptp(poses[:, :3, 3], axis=0) > (0.25, 0.1, 0.06)).all()
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = np.degrees(Rotation.from_matrix(poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]).magnitude())
    assert steps.max() < 0.03 and 0.3 < turns.max() < 1.5


def test_walk_starts_out_of_view(renderer: Renderer) -> None:
    assert not (rendered(renderer, 0.3).mover == 1).any()
    shares = [float((rendered(renderer, t).mover == 1).float().mean()) for t in (1.8, 2.4, 2.8)]
    assert all(0.10 < share < 0.25 for share in shares)
    assert walk(2.0).shift[0] > walk(1.0).shift[0]


def test_materials_are_textured() -> None:
    rng = np.random.default_rng(0)
    wall = materials.bricks(rng, 1.0, 0.5, 200, (0.7, 0.4, 0.3))
    assert wall.shape == (100, 200, 3) and wall.dtype == np.float32
    assert wall.min() >= 0.0 and wall.max() <= 1.0
    corners = cv2.goodFeaturesToTrack(cv2.cvtColor(wall, cv2.COLOR_RGB2GRAY), 500, 0.05, 3)
    assert len(corners) > 50


def fake_sequence(folder: Path, frames: range = range(2), progress: demo.Progress | None = None) -> None:
    folder.mkdir(parents=True)
    (folder / "rgb.txt").write_text("made")
    if progress is not None:
        progress(2, 2)


def test_made_once_and_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "write_sequence", fake_sequence)
    told: list[tuple[int, int]] = []
    folder = demo.ensure_demo(tmp_path / "cache", lambda done, total: told.append((done, total)))
    assert folder.parent == tmp_path / "cache" and (folder / "rgb.txt").read_text() == "made"
    assert demo.ensure_demo(tmp_path / "cache", lambda done, total: told.append((done, total))) == folder
    assert told == [(2, 2)]
    assert [p.name for p in (tmp_path / "cache").iterdir()] == [folder.name]


def test_an_interrupted_rendering_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(folder: Path, frames: range = range(2), progress: demo.Progress | None = None) -> None:
        fake_sequence(folder)
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "write_sequence", broken)
    with pytest.raises(KeyboardInterrupt):
        demo.ensure_demo(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_cache_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file")
    with pytest.raises(OutputError, match="cache"):
        demo.ensure_demo(tmp_path / "cache")
