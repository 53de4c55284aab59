"""Distances in pixels follow the size of the images."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.config import ObjectsConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.objects.image_scale import coarse_stride, scale_to_image
from v3d_torch.objects.instance_clouds import InstanceBackProjector
from v3d_torch.types import Instances

CONFIG = ObjectsConfig()


def camera_of(width: int, height: int, focal_length: float) -> PinholeCamera:
    return PinholeCamera(focal_length, focal_length, (width - 1) / 2, (height - 1) / 2, width, height)


def test_values_of_a_kinect_are_those_of_the_configuration() -> None:
    assert scale_to_image(CONFIG, camera_of(640, 480, 525.0)) == CONFIG
    assert scale_to_image(CONFIG, camera_of(640, 480, 615.0)) == CONFIG  # a longer focal length, such as a D435i's


@pytest.mark.parametrize(
    ("size", "focal_length", "stride", "margins"),
    [
        ((1280, 720), 920.0, 7, (2, 8, 16, 64)),
        ((320, 240), 262.5, 2, (1, 2, 4, 16)),
        ((424, 240), 212.0, 2, (1, 3, 5, 21)),
    ],
)
def test_stride_and_margins_scale_with_the_width_of_the_image(
    size: tuple[int, int], focal_length: float, stride: int, margins: tuple[int, int, int, int]
) -> None:
    scaled = scale_to_image(CONFIG, camera_of(*size, focal_length))
    mask = scaled.static_mask
    assert scaled.clouds.stride == stride
    assert (mask.dilation, mask.map_dilation, mask.depth_margin, mask.surface_margin) == margins


def test_coarse_images_have_about_160_columns() -> None:
    sizes = ((640, 480), (1280, 720), (848, 480), (424, 240), (320, 240), (64, 48))
    assert [coarse_stride(camera_of(*size, 525.0)) for size in sizes] == [4, 8, 5, 3, 2, 1]


@given(st.integers(16, 4000), st.floats(10, 4000))
def test_zero_stays_zero_and_everything_else_positive(width: int, focal_length: float) -> None:
    off = CONFIG.model_copy(
        update={"static_mask": CONFIG.static_mask.model_copy(update={"dilation": 0, "surface_margin": 0})}
    )
    scaled = scale_to_image(off, camera_of(width, width, focal_length))
    assert scaled.static_mask.dilation == scaled.static_mask.surface_margin == 0
    assert min(scaled.clouds.stride, scaled.static_mask.depth_margin, scaled.static_mask.map_dilation) >= 1


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (424, 240)])
def test_person_at_five_metres_has_a_centroid_in_images_of_any_size(size: tuple[int, int]) -> None:
    """A board of 0.5 m by 1.7 m in front of a camera with 62 degrees, with the depth noise of a Kinect."""
    width, height = size
    camera = camera_of(width, height, 525.0 * width / 640)
    depth = 5.0 + 0.0012 * 25 * torch.randn(1, height, width, generator=torch.Generator().manual_seed(0))
    rays = camera.rays
    mask = (rays[..., 0].abs() * 5 < 0.25) & (rays[..., 1].abs() * 5 < 0.85)
    instances = Instances(mask[None], torch.zeros(1, dtype=torch.int64), torch.ones(1), torch.zeros(1, 4))
    clouds = InstanceBackProjector(scale_to_image(CONFIG, camera).clouds, camera)(depth, instances)
    assert clouds.centroid.isfinite().all()
