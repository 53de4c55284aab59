"""Occupancy map of rendered rooms and of chosen voxels: states, queries, forgetting, bounded memory."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from helpers.box_room import CAMERA, CRATE, distance_to, looking_around, render
from helpers.occupancy_scenes import ALL, CONFIG, add_view, box_of_voxels, map_of, map_of_room
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from v3d_torch.config import OccupancyConfig
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.occupancy import occupancy_map
from v3d_torch.occupancy.clearance import NearestVoxels
from v3d_torch.occupancy.occupancy_map import OccupancyMap, VoxelState
from v3d_torch.occupancy.range_view import RangeView

SIZE = CONFIG.voxel_size
EYE = torch.eye(4, dtype=torch.float64)
NEAR_BOX = [[-0.2, -0.2, 1.2], [0.2, 0.2, 1.4]]


@pytest.fixture(scope="module")
def room() -> OccupancyMap:
    return map_of_room(views=40)


@pytest.fixture(scope="module")
def scattered() -> tuple[OccupancyMap, Tensor]:
    """Free box with scattered occupied voxels, and unknown space around; with the mask of the occupied voxels."""
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(40, 36, 33, generator=generator) < 0.002
    voxels = box_of_voxels((-20, -20, -20), (20, 16, 13))
    return map_of(voxels[mask.flatten()], voxels[~mask.flatten()]), mask


# --- content


def test_occupied_voxels_lie_on_the_surfaces_of_the_room(room: OccupancyMap) -> None:
    points = room.occupied_points
    assert len(points) > 5000
    assert distance_to(points, CRATE).max() <= SIZE * 3**0.5 / 2 + 1e-6


def test_free_voxels_contain_no_surface(room: OccupancyMap) -> None:
    inside = distance_to(room.free_points, CRATE) < SIZE / 4
    assert len(room.free_points) > 50_000 and inside.double().mean() < 0.001


def test_surfaces_that_are_seen_are_occupied(room: OccupancyMap) -> None:
    seen = torch.cat(
        [
            (CAMERA.rays * render(T_wc, CRATE)[0, ..., None])[::4, ::4].reshape(-1, 3).double() @ T_wc[:3, :3].T
            + T_wc[:3, 3]
            for T_wc in looking_around(40)[::5]
        ]
    )
    states = room.states(seen)
    assert (states == VoxelState.OCCUPIED).double().mean() > 0.98


def test_inside_of_the_crate_and_behind_the_walls_is_unknown(room: OccupancyMap) -> None:
    points = torch.stack([CRATE.double().mean(dim=0), torch.tensor([0.0, 0.0, 3.0]), torch.tensor([9.0, 9.0, 9.0])])
    assert room.states(points).tolist() == 3 * [VoxelState.UNKNOWN]
    assert room.probability(points).isnan().all() and room.distance(points).isnan().all()
    assert room.gradient(points).isnan().all() and not room.is_free(points).any()


def test_probabilities_agree_with_states(room: OccupancyMap) -> None:
    occupied, free = room.probability(room.occupied_points), room.probability(room.free_points)
    low, high = CONFIG.min_probability - 0.005, CONFIG.max_probability + 0.005
    assert occupied.min() >= 0.5 and occupied.max() <= high and low <= free.min() and free.max() < 0.5


def test_queries_keep_the_shape_of_batches(room: OccupancyMap) -> None:
    points = torch.rand(2, 3, 4, 3) - 0.5
    assert room.states(points).shape == room.distance(points).shape == room.is_free(points, 0.1).shape == (2, 3, 4)
    assert room.gradient(points).shape == points.shape
    assert torch.equal(room.states(points)[1, 2], room.states(points[1, 2]))


def test_empty_map_is_unknown_everywhere() -> None:
    occupancy = OccupancyMap(CONFIG)
    assert occupancy.is_empty and occupancy.states(torch.zeros(1, 3)).tolist() == [VoxelState.UNKNOWN]
    assert occupancy.distance(torch.zeros(2, 3)).isnan().all() and not occupancy.is_free(torch.zeros(1, 3)).any()


def test_map_does_not_depend_on_the_implementation(monkeypatch: pytest.MonkeyPatch) -> None:
    first = map_of_room(views=3)
    monkeypatch.setattr(compiler, "ENABLED", False)
    second = map_of_room(views=3)
    assert torch.equal(first.blocks.log_odds, second.blocks.log_odds)
    assert torch.equal(first.blocks.coordinates, second.blocks.coordinates)


# --- things that move


def test_box_that_was_taken_away_is_removed_from_the_map() -> None:
    occupancy = OccupancyMap(CONFIG)
    box = torch.tensor([[-0.2, -0.2, 0.9], [0.2, 0.2, 1.3]])
    for number in range(12):
        add_view(occupancy, number, EYE, box)
    in_box = occupancy.occupied_points
    in_box = in_box[((in_box >= box[0] - SIZE) & (in_box <= box[1] + SIZE)).all(dim=1)]
    assert len(in_box) > 50
    for number in range(12, 36):
        add_view(occupancy, number, EYE)
    assert (occupancy.states(in_box) == VoxelState.FREE).all()


def test_masked_object_leaves_no_trace_and_nothing_is_seen_behind_it() -> None:
    person = torch.tensor([[-0.2, -0.4, 0.9], [0.2, 0.4, 1.1]])
    occupancy = OccupancyMap(CONFIG)
    static = render(EYE, person)[0] == render(EYE)[0]
    for number in range(20):
        add_view(occupancy, number, EYE, person, static=static)
    points = occupancy.occupied_points
    assert distance_to(points).max() <= SIZE and len(points) > 500
    behind = torch.tensor([[0.0, 0.0, 1.4], [0.0, 0.0, 1.83]])
    assert occupancy.states(behind).tolist() == 2 * [VoxelState.UNKNOWN]
    assert occupancy.states(torch.tensor([[0.0, 0.0, 0.6]])).tolist() == [VoxelState.FREE]


@settings(max_examples=15)
@given(distance=st.floats(0.8, 1.6), fraction=st.floats(0.02, 0.8), turn=st.floats(-0.3, 0.3), seed=st.integers(0, 99))
def test_point_that_all_views_see_through_is_never_occupied(
    distance: float, fraction: float, turn: float, seed: int
) -> None:
    """A wall at a distance from a camera that turns a little; what is in front of the wall is free in every view."""
    occupancy = OccupancyMap(CONFIG)
    generator = torch.Generator().manual_seed(seed)
    depth = torch.full((CAMERA.height, CAMERA.width), distance)
    for number in range(3):
        noisy = depth + 0.002 * torch.randn(depth.shape, generator=generator)
        view = RangeView.sample(number, noisy, ALL, CONFIG.stride)
        twist = torch.tensor([0.0, 0.0, 0.0, 0.0, turn * number / 3, 0.0], dtype=torch.float64)
        occupancy.integrate(view.depth, view.static, view.rays(CAMERA, CONFIG.stride), se3_exp(twist))
    clear = distance - SIZE * 3**0.5 - SIZE / 2 - CONFIG.inverse_depth_tolerance * distance**2 - 0.02
    points = CAMERA.rays[40:200:20, 80:240:20].reshape(-1, 3).double() * fraction * clear
    assert (occupancy.states(points) != VoxelState.OCCUPIED).all()


# --- free balls


@pytest.mark.parametrize("query", ["states", "probability", "is_free", "distance", "gradient"])
@pytest.mark.parametrize("shape", [(2, 4), (3, 4), (5, 2), (4,)])
def test_points_of_another_shape_are_rejected(query: str, shape: tuple[int, ...], room: OccupancyMap) -> None:
    """Such as homogeneous points, before they are cut to three coordinates."""
    with pytest.raises(ShapeError, match=r"^points has the shape \(.*\); give a tensor of shape \(\.\.\., 3\)$"):
        getattr(room, query)(torch.ones(shape))


def is_free_by_brute_force(occupancy: OccupancyMap, point: Tensor, radius: float) -> bool:
    low = (point / SIZE).floor() - int(radius / SIZE) - 2
    span = 2 * int(radius / SIZE) + 5
    voxels = box_of_voxels((0, 0, 0), (span, span, span)).double() + low
    nearest = torch.minimum(torch.maximum(point, voxels * SIZE), (voxels + 1) * SIZE)
    touched = (nearest - point).norm(dim=1) <= radius
    return bool((occupancy.states((voxels[touched] + 0.5) * SIZE) == VoxelState.FREE).all())


@pytest.mark.parametrize("radius", [0.0, 0.03, 0.11, 0.2])
def test_free_balls_equal_brute_force(radius: float, scattered: tuple[OccupancyMap, Tensor]) -> None:
    occupancy, _ = scattered
    points = 2.4 * torch.rand(150, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1.3
    expected = [is_free_by_brute_force(occupancy, point, radius) for point in points]
    assert occupancy.is_free(points, radius).tolist() == expected
    assert any(expected) and not all(expected)
    twin = TWINS["v3d_torch.occupancy.clearance.are_balls_free"]
    assert twin.torch(occupancy.blocks, points, radius, SIZE).tolist() == expected


@settings(max_examples=30)
@given(point=st.tuples(*3 * [st.floats(-1, 1)]), radii=st.tuples(st.floats(0, 0.3), st.floats(0, 0.3)).map(sorted))
def test_ball_in_a_free_ball_is_free(
    point: tuple[float, ...], radii: list[float], scattered: tuple[OccupancyMap, Tensor]
) -> None:
    occupancy, (small, large) = scattered[0], radii
    points = torch.tensor([point], dtype=torch.float64)
    assert not occupancy.is_free(points, large).item() or occupancy.is_free(points, small).item()


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -1e12])
@pytest.mark.parametrize("column", [0, 3])
def test_pose_that_is_not_rigid_or_very_far_away_is_an_input_error(column: int, value: float) -> None:
    """A map with voxels at such a place could not be loaded, and the compiled ray casting ended the process."""
    occupancy = map_of(box_of_voxels((0, 0, 0), (1, 1, 1)), box_of_voxels((1, 0, 0), (2, 1, 1)))
    T_wc = EYE.clone()
    T_wc[0, column] = value
    before = occupancy.occupied_points
    with pytest.raises(InputError, match=r"^the pose T_wc of a depth image is .*; give a rigid transform, at most"):
        occupancy.integrate(torch.ones(2, 3), torch.ones(2, 3, dtype=torch.bool), CAMERA.rays[:2, :3], T_wc)
    assert torch.equal(occupancy.occupied_points, before)


def test_mask_of_static_pixels_of_another_type_is_rejected() -> None:
    with pytest.raises(InputError, match=r"^static has the type torch\.uint8; give a mask of type torch\.bool$"):
        OccupancyMap(CONFIG).integrate(torch.ones(2, 3), torch.ones(2, 3).to(torch.uint8), CAMERA.rays[:2, :3], EYE)


@pytest.mark.parametrize("size", [(0, 3), (2, 0)])
def test_image_without_pixels_is_an_input_error(size: tuple[int, int]) -> None:
    static, rays = torch.ones(size, dtype=torch.bool), torch.ones(*size, 3)
    with pytest.raises(InputError, match=r"^the depth image has shape \(\d, \d\); give an image with pixels$"):
        OccupancyMap(CONFIG).integrate(torch.ones(size), static, rays, EYE)


@pytest.mark.parametrize("query", ["states", "probability", "is_free", "distance", "gradient"])
def test_points_in_an_array_are_rejected(query: str, room: OccupancyMap) -> None:
    with pytest.raises(InputError, match=r"^points is of type ndarray; give a torch.Tensor of shape \(\.\.\., 3\)$"):
        getattr(room, query)(np.ones((4, 3)))


def test_radius_can_be_a_tensor(room: OccupancyMap) -> None:
    points = room.free_points[::100]
    assert torch.equal(room.is_free(points, torch.tensor(0.2)), room.is_free(points, float(torch.tensor(0.2))))


@pytest.mark.parametrize("radius", [-0.1, torch.nan, torch.inf])
def test_radius_that_is_negative_or_not_finite_is_an_input_error(radius: float, room: OccupancyMap) -> None:
    with pytest.raises(InputError, match=rf"the radius of balls is {radius} m; give a finite radius of at least 0"):
        room.is_free(room.free_points[:2], radius)


@pytest.mark.parametrize("radius", [1e3, 1e5, 1e300])
def test_ball_that_is_larger_than_the_map_is_not_free(
    radius: float, room: OccupancyMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    def visit(*_: object) -> None:
        raise AssertionError("visits a voxel")

    monkeypatch.setattr("v3d_torch.occupancy.occupancy_map.are_balls_free", visit)
    assert room.is_free(room.free_points[:2].reshape(1, 2, 3), radius).tolist() == [[False, False]]
    assert not OccupancyMap(CONFIG).is_free(torch.zeros(3), radius)


# --- distances


def test_distances_at_voxel_centres_equal_the_euclidean_distance_transform(
    scattered: tuple[OccupancyMap, Tensor],
) -> None:
    occupancy, mask = scattered
    centres = (box_of_voxels((-20, -20, -20), (20, 16, 13)).double() + 0.5) * SIZE
    expected = distance_transform_edt(~mask.numpy(), sampling=SIZE).clip(max=CONFIG.max_distance).reshape(-1)
    np.testing.assert_allclose(occupancy.distance(centres).numpy(), expected, rtol=0, atol=1e-12)


def test_distances_of_a_room_are_those_to_its_surfaces(room: OccupancyMap) -> None:
    points = room.free_points[::300]
    true = distance_to(points, CRATE)
    error = (room.distance(points) - true)[true < CONFIG.max_distance - 0.1]
    # Surfaces that were not seen, such as the floor near the camera, can only be missing.
    assert len(error) > 100 and error.min() > -SIZE and error.median() < SIZE / 2 and error.quantile(0.8) < SIZE


def test_distances_are_truncated() -> None:
    voxels = box_of_voxels((0, 0, 0), (60, 3, 3))
    occupancy = map_of(voxels[:1], voxels[1:])
    far = torch.tensor([[55.5, 1.5, 1.5]]) * SIZE
    assert occupancy.distance(far).item() == CONFIG.max_distance and occupancy.gradient(far).abs().sum() == 0


def test_gradient_is_the_derivative_of_the_distance(scattered: tuple[OccupancyMap, Tensor]) -> None:
    occupancy, _ = scattered
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.5
    points.requires_grad_()
    distance = occupancy.distance(points)
    (expected,) = torch.autograd.grad(distance.sum(), points)
    torch.testing.assert_close(occupancy.gradient(points.detach()), expected)
    lengths = expected.norm(dim=1)
    assert ((lengths - 1).abs() < 1e-9).sum() > 50
    assert torch.autograd.gradcheck(occupancy.distance, points[:4].detach().requires_grad_())


def test_gradient_at_the_centre_of_an_occupied_voxel_is_zero() -> None:
    occupancy = map_of(torch.zeros(1, 3, dtype=torch.int64), torch.ones(1, 3, dtype=torch.int64))
    centre = torch.full((1, 3), SIZE / 2, dtype=torch.float64)
    assert occupancy.distance(centre).item() == 0 and occupancy.gradient(centre).tolist() == [[0.0, 0.0, 0.0]]


def test_distances_follow_the_map() -> None:
    occupancy, point = OccupancyMap(CONFIG), torch.tensor([[0.0, 0.0, 1.0]])
    add_view(occupancy, 0, EYE)
    before = occupancy.distance(point)
    add_view(occupancy, 1, EYE, torch.tensor(NEAR_BOX))
    assert occupancy.distance(point) < before - 0.3


def test_distances_follow_a_view_that_is_added_while_another_thread_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tree of the map without the view stayed in use."""
    occupancy, point, box = OccupancyMap(CONFIG), torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor(NEAR_BOX)
    add_view(occupancy, 0, EYE)

    class Slow(NearestVoxels):
        def __init__(self, centres: Tensor, max_distance: float) -> None:
            super().__init__(centres, max_distance)
            monkeypatch.undo()
            add_view(occupancy, 1, EYE, box)

    monkeypatch.setattr(occupancy_map, "NearestVoxels", Slow)
    before = occupancy.distance(point)
    assert occupancy.distance(point) < before - 0.3


def test_blocks_that_another_thread_reads_keep_their_index() -> None:
    """Their keys belonged to other rows while blocks were added or removed."""
    occupancy = OccupancyMap(OccupancyConfig(max_blocks=20, window_radius=0.1))
    add_view(occupancy, 0, EYE)
    blocks, coordinates = occupancy.blocks, occupancy.blocks.coordinates
    for number, T_wc in enumerate(looking_around(6)):
        add_view(occupancy, number, T_wc)
    assert occupancy.blocks is not blocks and blocks.coordinates is coordinates
    assert len(blocks.keys) == len(blocks.rows) == len(coordinates) == len(blocks.log_odds)


@pytest.mark.parametrize("change", ["replace_blocks", "load_state_dict"])
def test_distances_follow_a_replaced_content(change: str) -> None:
    row = box_of_voxels((0, 0, 0), (12, 1, 1))
    occupancy, other = map_of(row[:1], row[1:]), map_of(row[9:], row[:9])
    points = (row + 0.5) * SIZE
    assert not torch.equal(occupancy.distance(points), other.distance(points))
    if change == "replace_blocks":
        occupancy.replace_blocks(other.blocks)
    else:
        occupancy.load_state_dict(other.state_dict())
    assert torch.equal(occupancy.distance(points), other.distance(points))


def test_depth_beyond_the_range_of_stored_views_shows_the_same_free_space() -> None:
    maps = [OccupancyMap(CONFIG) for _ in range(2)]
    for occupancy, depth in zip(maps, (12.0, 20.0), strict=True):
        view = RangeView.sample(0, torch.full((CAMERA.height, CAMERA.width), depth), ALL, CONFIG.stride)
        occupancy.integrate(view.depth, view.static, view.rays(CAMERA, CONFIG.stride), EYE)
    near, far = maps
    assert torch.equal(far.free_points, near.free_points) and len(far.free_points) > 1000
    assert len(far.occupied_points) == 0


# --- memory


def test_memory_is_bounded_on_a_long_drive(caplog: pytest.LogCaptureFixture) -> None:
    config = OccupancyConfig(max_blocks=150, window_radius=2.5)
    occupancy, sizes = OccupancyMap(config), []
    with caplog.at_level(logging.WARNING):
        for number in range(60):
            T_wc = EYE.clone()
            T_wc[0, 3] = 2.0 * number  # sideways along a corridor, in rooms that repeat
            view = RangeView.sample(number, render(EYE)[0], ALL, config.stride)
            occupancy.integrate(view.depth, view.static, view.rays(CAMERA, config.stride), T_wc)
            sizes.append(len(occupancy.blocks))
    assert max(sizes) <= config.max_blocks and len(occupancy.blocks.log_odds) <= config.max_blocks
    assert sizes[5] < sizes[10] and min(sizes[20:]) > config.max_blocks / 2
    assert "blocks were removed, all farther than" in caplog.text and "occupancy.max_blocks" in caplog.text
    near = occupancy.occupied_points[:, 0]
    assert near.max() > 2.0 * 59 and near.min() > 2.0 * 20  # the farthest were removed


def test_blocks_around_the_camera_are_never_removed(caplog: pytest.LogCaptureFixture) -> None:
    """It is reported once, and no block is copied."""
    occupancy = OccupancyMap(OccupancyConfig(max_blocks=1, window_radius=6.0))
    add_view(occupancy, 0, EYE)
    blocks = occupancy.blocks.log_odds.data_ptr()
    for _ in range(3):
        add_view(occupancy, 0, EYE)
    assert len(occupancy.blocks) > 10 and occupancy.blocks.log_odds.data_ptr() == blocks
    (message,) = (record.getMessage() for record in caplog.records)
    assert message == (
        f"occupancy map: all {len(occupancy.blocks)} blocks within 6.0 m of the camera are kept, although"
        " occupancy.max_blocks is 1; set larger voxels (occupancy.voxel_size is 0.05 m), or a larger"
        " occupancy.max_blocks"
    )


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf, 1e30])
@pytest.mark.parametrize("radius", [0.0, 0.1])
def test_points_that_are_not_finite_or_very_far_away_are_unknown(
    bad: float, radius: float, room: OccupancyMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = room.free_points[:3].clone()
    points[1, 0] = bad
    assert not room.is_free(points, radius)[1]
    monkeypatch.setattr(compiler, "ENABLED", False)
    assert not room.is_free(points, radius)[1]
    assert room.distance(points).isnan().tolist() == [False, True, False]
    assert room.gradient(points).isnan().any(dim=1).tolist() == [False, True, False]
    assert room.states(points)[1] == VoxelState.UNKNOWN and room.probability(points)[1].isnan()


def test_distances_after_a_change_need_a_search_near_the_points_only(
    scattered: tuple[OccupancyMap, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planner asks for a few places of each new map; the second place is searched in the whole map."""
    occupancy, mask = scattered
    sizes: list[int] = []

    class Counting(NearestVoxels):
        def __init__(self, centres: Tensor, max_distance: float) -> None:
            sizes.append(len(centres))
            super().__init__(centres, max_distance)

    monkeypatch.setattr(occupancy_map, "NearestVoxels", Counting)
    points = (box_of_voxels((-20, -20, -20), (20, 16, 13)).to(torch.float64) + 0.5) * SIZE
    expected = occupancy.distance(points)
    other = OccupancyMap(CONFIG.model_copy(update={"max_distance": 2 * SIZE}))
    other.load_state_dict(occupancy.state_dict())
    near, far = points[:5], points[-5:]
    for place, rows in ((near, slice(5)), (near, slice(5)), (far, slice(-5, None)), (points, slice(None))):
        assert torch.equal(other.distance(place), expected[rows].clamp(max=2 * SIZE))
    assert sizes[-2] < sizes[-1] == mask.sum() and len(sizes) <= 3
