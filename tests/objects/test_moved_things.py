"""A box that is carried and put down, in frames of ``demo:things`` with true masks of people and chairs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.datasets.demo.renderer import Renderer, Rendering
from v3d_torch.datasets.demo.scenes.things import PUT_DOWN, build_things_scene
from v3d_torch.datasets.demo.sensor_model import simulate_colour, simulate_depth
from v3d_torch.datasets.demo.sequence import SEED
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.segmentation.coco import COCO_NAMES
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame

CAMERA = PinholeCamera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240, depth_scale=5000.0, readout=0.0)
RATE = 10
FRAMES = range(1, 30)  # the longer time span of the free-space check is reached before the box is carried
BOX, STILL_CHAIR = 3, 9


@pytest.fixture(scope="module")
def masked() -> dict[int, dict[int, float]]:
    """Fraction of the box and of the chair that stands still that tracking leaves out, by frame."""
    renderer = Renderer(build_things_scene(SEED), CAMERA)
    rendered: dict[int, Rendering] = {}

    def segment(frame: RGBDFrame) -> Instances:
        instance_mask, labels = rendered[frame.index].instance_mask, renderer.scene.labels
        ids = [i for i in instance_mask.unique().tolist() if i in labels]
        masks = torch.stack([instance_mask == i for i in ids])
        classes = torch.tensor([COCO_NAMES.index(labels[i]) for i in ids])
        return Instances(masks, classes, torch.ones(len(ids)), torch.tensor([box_of(mask) for mask in masks]))

    slam = V3DSLAM(CAMERA, segment, load_config())
    fractions: dict[int, dict[int, float]] = {BOX: {}, STILL_CHAIR: {}}
    for index, number in enumerate(FRAMES):
        time = number / RATE
        rendered[index] = view = renderer(renderer.scene.trajectory.pose(time), time)
        generator = torch.Generator().manual_seed(number)
        colour = simulate_colour(view.colour, generator).permute(2, 0, 1).contiguous()
        depth = simulate_depth(view.depth, CAMERA, generator).to(torch.float32)[None]
        result = slam(RGBDFrame(index, time, colour, depth, camera=CAMERA))
        for thing, of_thing in fractions.items():
            of_thing[number] = float((~result.static_mask)[view.instance_mask == thing].float().mean())
    return fractions


def box_of(mask: Tensor) -> list[float]:
    """Left, top, right and bottom edge of a mask."""
    v, u = torch.nonzero(mask).unbind(dim=1)
    return [float(u.min()), float(v.min()), float(u.max()) + 1, float(v.max()) + 1]


def test_box_without_a_class_is_left_out_while_it_is_carried(masked: dict[int, dict[int, float]]) -> None:
    carried = [fraction for number, fraction in masked[BOX].items() if 1.0 <= number / RATE < PUT_DOWN]
    assert min(carried) > 0.7


def test_box_that_is_put_down_is_static_within_a_second(masked: dict[int, dict[int, float]]) -> None:
    later = [fraction for number, fraction in masked[BOX].items() if number / RATE >= PUT_DOWN + 0.9]
    assert later and max(later) < 0.4


def test_chair_that_stands_still_is_static(masked: dict[int, dict[int, float]]) -> None:
    assert sum(fraction > 0.3 for fraction in masked[STILL_CHAIR].values()) <= 2
