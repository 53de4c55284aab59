"""Instance clouds: points of the object are kept, points of the background inside the mask are removed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sklearn.cluster import DBSCAN
from torch import Tensor

from v3d_torch.config import CloudConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.instance_clouds import InstanceBackProjector, InstanceClouds
from v3d_torch.types import Instances

CAMERA = PinholeCamera(fx=525.0, fy=525.0, cx=319.5, cy=239.5)
WALL = 3.5
RIM = 0.01 + 0.002  # metres: error of the rim, half a voxel and half a pixel at the depth of the object
OBJECT = 2.0
COLUMNS, ROWS = (280, 400), (150, 330)  # of the object in the image, half-open


def instances(*masks: Tensor) -> Instances:
    count = len(masks)
    return Instances(
        torch.stack(masks), torch.zeros(count, dtype=torch.int64), torch.ones(count), torch.zeros(count, 4)
    )


def rectangle(columns: tuple[int, int] = COLUMNS, rows: tuple[int, int] = ROWS, margin: int = 0) -> Tensor:
    mask = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    mask[rows[0] - margin : rows[1] + margin, columns[0] - margin : columns[1] + margin] = True
    return mask


def board() -> Tensor:
    """Return the depth of a flat board in front of a wall, both parallel to the image."""
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    depth[0, rectangle()] = OBJECT
    return depth


def true_centre(columns: tuple[int, int] = COLUMNS, rows: tuple[int, int] = ROWS, z: float = OBJECT) -> Tensor:
    """Return the 3D centre of a rectangle of the image, metres."""
    u, v = (sum(columns) - 1) / 2, (sum(rows) - 1) / 2
    return torch.tensor([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z])


def error(clouds: InstanceClouds, columns: tuple[int, int] = COLUMNS, rows: tuple[int, int] = ROWS) -> float:
    """Return the largest error of the first centroid over the axes, for a rectangle at the object's depth, metres."""
    return float((clouds.centroid[0] - true_centre(columns, rows)).abs().max())


def back_project(depth: Tensor, *masks: Tensor, **config: float) -> InstanceClouds:
    return InstanceBackProjector(CloudConfig(**config), CAMERA)(depth, instances(*masks))


def test_convention_cloud_is_right_down_forward_in_metres() -> None:
    depth = torch.zeros(1, CAMERA.height, CAMERA.width)
    right_below = rectangle((500, 600), (350, 450))
    depth[0, right_below] = 1.5
    clouds = back_project(depth, right_below)
    x, y, z = clouds.points[0, clouds.valid[0]].unbind(dim=1)
    assert 0.515 < float(x.min()) < float(x.max()) < 0.802
    assert 0.315 < float(y.min()) < float(y.max()) < 0.602
    torch.testing.assert_close(z, torch.full_like(z, 1.5))


@pytest.mark.parametrize("shift", range(0, 12, 2))
def test_centroid_of_a_board_is_exact_to_half_a_voxel(shift: int) -> None:
    """The accuracy is limited because a voxel of the rim counts fully, even if the board fills only a part of it."""
    columns, rows = (COLUMNS[0] + shift, COLUMNS[1] + shift), (ROWS[0] + shift, ROWS[1] + shift)
    clouds = back_project(torch.full((1, CAMERA.height, CAMERA.width), OBJECT), rectangle(columns, rows))
    assert error(clouds, columns, rows) < RIM
    assert abs(float(clouds.centroid[0, 2]) - OBJECT) < 1e-5


def test_centroid_of_a_board_of_whole_voxels_is_exact_to_a_millimetre() -> None:
    """0.4 m by 0.2 m at 1.05 m: a pixel is 2 mm, and ten pixels make a voxel."""
    columns, rows = (320, 520), (140, 240)
    depth = torch.full((1, CAMERA.height, CAMERA.width), 1.05)
    centroid = back_project(depth, rectangle(columns, rows), stride=1).centroid[0]
    assert float((centroid - true_centre(columns, rows, 1.05)).abs().max()) < 0.001


def test_centroid_is_the_mean_of_the_valid_points() -> None:
    clouds = back_project(board(), rectangle(), rectangle((20, 90), (20, 90)))
    for points, valid, centroid in zip(clouds.points, clouds.valid, clouds.centroid, strict=True):
        torch.testing.assert_close(centroid, points[valid].mean(dim=0), rtol=0.0, atol=1e-5)


def test_each_voxel_has_one_point() -> None:
    clouds = back_project(board(), rectangle(), stride=2)
    voxels = (clouds.points[0, clouds.valid[0]] / 0.02).floor()
    assert len(voxels) == len(voxels.unique(dim=0))
    # 120 x 180 pixels at 2 m are 0.457 m x 0.686 m, 784 voxels, some of them cut by the border.
    assert 784 <= len(voxels) <= 24 * 36


def test_wall_inside_the_mask_is_removed() -> None:
    exact = back_project(board(), rectangle())
    enlarged = back_project(board(), rectangle(margin=6))
    assert float(enlarged.points[0, enlarged.valid[0], 2].max()) < OBJECT + 0.01
    assert error(enlarged) < RIM
    assert float((enlarged.centroid[0] - exact.centroid[0]).norm()) < 0.001
    # Without rejection the mean would be off by far more than the vote threshold.
    pixels = rectangle(margin=6)
    assert abs(float(board()[0, pixels].mean()) - OBJECT) > 0.2


@pytest.mark.parametrize("gap", [0.15, 0.3, 1.0])
def test_wall_behind_a_gap_of_two_radii_is_removed(gap: float) -> None:
    depth = board()
    depth[0, ~rectangle()] = OBJECT + gap
    clouds = back_project(depth, rectangle(margin=8))
    assert float(clouds.points[0, clouds.valid[0], 2].max()) < OBJECT + 0.01


@pytest.mark.parametrize("stride", [1, 2, 5])
def test_cloud_pixels_exclude_the_wall_inside_the_mask(stride: int) -> None:
    """Columns and rows of the board are multiples of the strides, so that whole blocks are kept or removed."""
    exact, enlarged = (
        back_project(board(), mask, stride=stride).cloud_pixels for mask in (rectangle(), rectangle(margin=7))
    )
    assert exact.dtype == torch.bool
    assert torch.equal(exact, rectangle()[None])
    assert torch.equal(enlarged, rectangle()[None])


def test_cloud_pixels_lie_in_valid_voxels() -> None:
    """Comparison pixel by pixel on a noisy board with flying pixels and holes, for two overlapping masks."""
    generator = torch.Generator().manual_seed(3)
    depth = board() + 0.005 * torch.randn(board().shape, generator=generator)
    flying = torch.rand(depth.shape, generator=generator)
    depth = torch.where(flying < 0.03, depth + 8 * flying, torch.where(flying > 0.95, 0.0, depth))
    masks = (rectangle(margin=9), rectangle((300, 450), (100, 200)))
    clouds = back_project(depth, *masks, stride=1)
    voxels = (CAMERA.rays * depth[0, ..., None] / 0.02).floor().long()
    for points, valid, pixels, mask in zip(clouds.points, clouds.valid, clouds.cloud_pixels, masks, strict=True):
        kept = {tuple(voxel) for voxel in (points[valid] / 0.02).floor().long().tolist()}
        expected = torch.zeros_like(mask)
        expected[mask] = torch.tensor([tuple(voxel) in kept for voxel in voxels[mask].tolist()])
        expected &= depth[0] > 0
        # By rounding, the mean of a voxel can lie on its face.
        assert float((pixels ^ expected).sum()) < 0.001 * float(expected.sum())
        assert 0.3 * int(mask.sum()) < int(pixels.sum()) < 0.97 * int(mask.sum())
        assert not pixels[(depth[0] == 0) | ~mask].any()


def test_flying_pixels_are_removed() -> None:
    depth = board()
    generator = torch.Generator().manual_seed(0)
    rim = rectangle(margin=3) & ~rectangle(margin=-3)
    flying = rim & (torch.rand(rim.shape, generator=generator) < 0.05)
    depth[0, flying] = OBJECT + 0.2 + (WALL - OBJECT - 0.3) * torch.rand(int(flying.sum()), generator=generator)
    clouds = back_project(depth, rectangle(margin=3))
    assert float(clouds.points[0, clouds.valid[0], 2].max()) < OBJECT + 0.09
    assert error(clouds) < RIM


def test_largest_of_two_parts_is_kept_in_any_order() -> None:
    depth = board()
    for small in ((100, 160), (520, 580)):
        rows = (200, 260)
        depth[0, rectangle(small, rows)] = OBJECT
        clouds = back_project(depth, rectangle() | rectangle(small, rows))
        assert error(clouds) < RIM


@pytest.mark.parametrize(
    ("offset", "is_kept"), [(0.0, True), (0.08, True), (-0.08, True), (0.12, False), (-0.12, False)]
)
def test_object_split_by_an_occluder_keeps_both_parts_if_they_have_nearly_the_same_depth(
    offset: float, is_kept: bool
) -> None:
    depth = board()
    pole, left, right = rectangle((320, 350), (0, 480)), rectangle((280, 320)), rectangle((350, 400))
    depth[0, left] = OBJECT + offset
    depth[0, pole] = 1.0
    clouds = back_project(depth, rectangle() & ~pole)
    kept = [float(clouds.cloud_pixels[0][part].double().mean()) for part in (left, right)]
    assert kept[1] > 0.94 and (kept[0] > 0.94 if is_kept else kept[0] == 0)


@pytest.mark.parametrize(("width", "is_kept"), [(30, False), (50, True)])
def test_cluster_with_less_than_a_fifth_of_the_points_is_no_part_of_the_object(width: int, is_kept: bool) -> None:
    large, small = rectangle((100, 300)), rectangle((340, 340 + width))
    depth = torch.full((1, CAMERA.height, CAMERA.width), WALL)
    depth[0, large | small] = OBJECT
    clouds = back_project(depth, large | small)
    assert bool(clouds.cloud_pixels[0][small].any()) is is_kept


def test_clusters_equal_scikit_learn() -> None:
    depth = board()
    depth[0, :, 310:318] = 2.06  # within the radius of the board: same cluster
    mask = rectangle(margin=10)
    every = back_project(depth, mask, eps=100.0, min_samples=1)  # all points in one cluster
    points = every.points[0, every.valid[0]]
    labels = torch.from_numpy(DBSCAN(eps=0.08, min_samples=5).fit(points.double().numpy()).labels_)
    largest = labels[labels >= 0].bincount().argmax()
    clouds = back_project(depth, mask)
    torch.testing.assert_close(clouds.points[0, clouds.valid[0]], points[labels == largest])


def test_depth_noise_moves_the_centroid_by_less_than_a_centimetre() -> None:
    exact = back_project(board(), rectangle()).centroid
    for seed in range(3):
        noise = torch.randn(board().shape, generator=torch.Generator().manual_seed(seed))
        noisy = back_project(board() + 0.0014 * board().square() * noise, rectangle(margin=4)).centroid
        assert float((noisy - exact).abs().max()) < RIM


def test_instances_without_a_cloud_have_nan_centroid_and_do_not_affect_others() -> None:
    depth = board()
    hole, far, speck = rectangle((20, 80), (20, 80)), rectangle((20, 80), (120, 180)), rectangle((150, 160), (10, 20))
    depth[0, hole] = 0.0
    depth[0, far] = 6.5
    clouds = back_project(depth, hole, far, rectangle(), speck, torch.zeros_like(hole), stride=2)
    torch.testing.assert_close(torch.isnan(clouds.centroid).all(dim=1), torch.tensor([True, True, False, True, True]))
    assert clouds.valid.sum(dim=1)[[0, 1, 4]].tolist() == [0, 0, 0]
    assert not clouds.cloud_pixels[[0, 1, 4]].any()
    assert torch.equal(clouds.cloud_pixels[2], rectangle())
    torch.testing.assert_close(clouds.centroid[2], back_project(depth, rectangle(), stride=2).centroid[0])


def test_instances_without_depth_have_no_points() -> None:
    clouds = back_project(torch.zeros(1, CAMERA.height, CAMERA.width), rectangle(), rectangle((0, 10), (0, 10)))
    assert len(clouds) == 2
    assert not clouds.valid.any()
    assert torch.isnan(clouds.centroid).all()


def test_no_instances_give_empty_clouds() -> None:
    clouds = InstanceBackProjector(CloudConfig(), CAMERA)(board(), Instances.empty(CAMERA.height, CAMERA.width))
    assert len(clouds) == 0
    assert clouds.centroid.shape == (0, 3)
    assert clouds.valid.shape[0] == 0
    assert clouds.cloud_pixels.shape == (0, CAMERA.height, CAMERA.width)


def test_centroid_needs_min_points() -> None:
    count = int(back_project(board(), rectangle()).valid.sum())
    assert torch.isfinite(back_project(board(), rectangle(), min_points=count).centroid).all()
    assert torch.isnan(back_project(board(), rectangle(), min_points=count + 1).centroid).all()


def test_missing_depth_is_ignored() -> None:
    depth = board()
    generator = torch.Generator().manual_seed(1)
    depth[0, torch.rand(depth.shape[1:], generator=generator) < 0.3] = 0.0
    clouds = back_project(depth, rectangle())
    assert float(clouds.points[0, clouds.valid[0], 2].min()) > OBJECT - 0.001
    assert error(clouds) < RIM


def test_clouds_of_instances_are_independent() -> None:
    masks = [rectangle(), rectangle(margin=20), rectangle((0, 640), (0, 480)), rectangle((600, 640), (440, 480))]
    together = back_project(board(), *masks)
    for i, mask in enumerate(masks):
        alone = back_project(board(), mask)
        assert torch.equal(together.points[i, together.valid[i]], alone.points[0, alone.valid[0]])


def test_hundred_instances_on_a_grid_have_exact_centroids() -> None:
    places = [((64 * c, 64 * c + 48), (48 * r, 48 * r + 36)) for r in range(10) for c in range(10)]
    masks = [rectangle(*place) for place in places]
    clouds = back_project(torch.full((1, CAMERA.height, CAMERA.width), OBJECT), *masks, stride=2)
    expected = torch.stack([true_centre(*place) for place in places])
    assert float((clouds.centroid - expected).norm(dim=1).max()) < 0.01


def test_stride_reduces_points_and_keeps_the_centroid() -> None:
    fine, coarse = back_project(board(), rectangle(), stride=1), back_project(board(), rectangle(), stride=4)
    assert float((fine.centroid - coarse.centroid).abs().max()) < 2 * RIM
    # At 2 m every 4th pixel is 1.5 cm from the next: no more points than pixels.
    assert int(coarse.valid.sum()) <= 30 * 45


def test_lens_distortion_is_removed() -> None:
    """A plane parallel to the image of a camera with strong distortion: the points lie on the undistorted rays."""
    camera = PinholeCamera(517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    corner = rectangle((500, 620), (340, 460))
    depth = torch.full((1, 480, 640), OBJECT)
    clouds = InstanceBackProjector(CloudConfig(), camera)(depth, instances(corner))
    points = clouds.points[0, clouds.valid[0]]
    projected = camera.distort(camera.project(points.double()))
    assert 499 < float(projected[:, 0].min()) < float(projected[:, 0].max()) < 620
    assert 339 < float(projected[:, 1].min()) < float(projected[:, 1].max()) < 460
    undistorted = torch.tensor([(559.5 - 318.6) / 517.3, (399.5 - 255.3) / 516.5, 1.0]) * OBJECT
    assert float((clouds.centroid[0] - undistorted).norm()) > 0.01


def test_repeated_results_are_identical() -> None:
    noise = 0.01 * torch.randn(board().shape, generator=torch.Generator().manual_seed(2))
    first, second = (
        back_project(board() + noise, rectangle(margin=5), rectangle((10, 90), (10, 90))) for _ in range(2)
    )
    assert first.points.numpy().tobytes() == second.points.numpy().tobytes()
    assert first.centroid.numpy().tobytes() == second.centroid.numpy().tobytes()


def test_image_of_one_coarse_row_has_clouds() -> None:
    camera = replace(CAMERA, height=96, cy=48.0)
    depth = torch.full((1, 96, camera.width), 2.0)
    whole = Instances.from_masks(torch.ones(1, 96, camera.width, dtype=torch.bool), torch.tensor([0]))
    clouds = InstanceBackProjector(CloudConfig(stride=100), camera)(depth, whole)
    assert len(clouds) == 1
