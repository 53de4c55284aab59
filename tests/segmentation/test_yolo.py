"""The real networks on photographs. Their weights come the way a user's do: from the cache or a download."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from helpers.photographs import photograph
from onnx import TensorProto, helper
from PIL import Image, ImageDraw

import v3d_torch.segmentation.yolo
from v3d_torch.config import SegmentationConfig
from v3d_torch.errors import ConfigError, WeightsError
from v3d_torch.segmentation import (
    COCO_NAMES,
    PERSON,
    MaskFolder,
    NoSegmentation,
    YOLOSegmenter,
    make_segmenter,
)
from v3d_torch.segmentation.export import exported_path
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.segmentation.weights import REGISTRY, resolve
from v3d_torch.types import RGBDFrame

SMALL = {"height": 320, "width": 320, "threads": 1}

LARGE = {"height": 480, "width": 640, "threads": 1}
"""As large as the photographs: what is found in smaller ones is another thing."""

ASTRONAUT = [(155, 60), (190, 20), (260, 20), (300, 70), (295, 120), (270, 150), (300, 215), (340, 260), (360, 350)]
ASTRONAUT += [(290, 390), (280, 511), (20, 511), (15, 400), (60, 250), (115, 200), (125, 160), (175, 140)]
"""Outline of the person drawn by hand, (u, v)."""


@pytest.fixture(scope="module", params=list(product(REGISTRY, ("float32", "int8"))), ids="-".join)
def segmenter(request: pytest.FixtureRequest) -> YOLOSegmenter:
    """Each model in each precision, the 8-bit one also on processors where the program would not run it."""
    model, precision = request.param
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(v3d_torch.segmentation.yolo, "is_worth_it", lambda: True)
        return YOLOSegmenter(SegmentationConfig(model=model, precision=precision, **LARGE))


def test_the_astronaut_is_a_person_where_she_stands(segmenter: YOLOSegmenter) -> None:
    assert_astronaut(segmenter)


def test_so_she_is_at_the_default_size() -> None:
    assert_astronaut(YOLOSegmenter(SegmentationConfig(threads=1)))


def assert_astronaut(segmenter: YOLOSegmenter) -> None:
    instances = segmenter.segment(photograph("astronaut"))
    assert instances.labels[0] == PERSON
    assert instances.scores[0] > 0.8
    outline = Image.new("1", (512, 512))
    ImageDraw.Draw(outline).polygon(ASTRONAUT, fill=1)
    expected = torch.from_numpy(np.array(outline))
    mask = instances.masks[0]
    assert (mask & expected).sum() / (mask | expected).sum() > 0.9


@pytest.mark.parametrize(("name", "label", "area"), [("coffee", "cup", (0.15, 0.3)), ("chelsea", "cat", (0.6, 0.9))])
def test_cup_and_cat_are_found(segmenter: YOLOSegmenter, name: str, label: str, area: tuple[float, float]) -> None:
    image = photograph(name)
    instances = segmenter.segment(image)
    assert COCO_NAMES[instances.labels[0]] == label
    assert area[0] < instances.masks[0].float().mean() < area[1]
    assert instances.masks.shape[1:] == image.shape[1:]
    assert torch.equal(instances.scores, instances.scores.sort(descending=True).values)
    left, top, right, bottom = instances.boxes.unbind(dim=1)
    for mask, *edges in zip(instances.masks, left, top, right, bottom, strict=True):
        v, u = torch.nonzero(mask).T
        assert edges[0] <= u.min() and edges[1] <= v.min() and u.max() < edges[2] and v.max() < edges[3]


def test_convention_channels_are_red_green_blue(segmenter: YOLOSegmenter) -> None:
    """The ginger cat turns blue, and less of a cat, when red and blue are swapped."""
    image = photograph("chelsea")
    found, swapped = (segmenter.segment(channels).scores for channels in (image, image.flip(0)))
    assert found[0] > (swapped[0] if len(swapped) else 0.0) + 0.05


def test_same_bytes_with_one_thread_and_two() -> None:
    image = photograph("coffee")
    one, two = (YOLOSegmenter(SegmentationConfig(**(SMALL | {"threads": threads}))) for threads in (1, 2))
    first, again = one.segment(image), one.segment(image)
    try:
        torch.set_num_threads(2)
        other = two.segment(image)
    finally:
        torch.set_num_threads(1)
    for name in ("masks", "labels", "scores", "boxes"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert torch.equal(getattr(first, name), getattr(other, name))


def test_a_mirrored_image_gives_mirrored_masks() -> None:
    """Nothing may be shifted by a pixel or two on the way to the canvas and back."""
    segmenter = YOLOSegmenter(SegmentationConfig(**LARGE))
    image = photograph("astronaut")
    mask = segmenter.segment(image).masks[0]
    mirrored = segmenter.segment(image.flip(2)).masks[0].flip(1)
    assert (mask & mirrored).sum() / (mask | mirrored).sum() > 0.975


@pytest.mark.parametrize("turns", range(4))
def test_a_rolled_camera_finds_the_person_as_well(turns: int) -> None:
    """The mask is the one of the upright picture, turned as the camera is."""
    network = YOLOSegmenter(SegmentationConfig(**LARGE))
    image = photograph("astronaut")
    held = torch.rot90(image, turns, dims=(1, 2)).contiguous()
    here = torch.eye(4, dtype=torch.float64)
    seen = UprightSegmenter(network)(RGBDFrame(0, 0.0, held, torch.ones(1, 512, 512), here))
    assert seen.labels[0] == PERSON
    mask, expected = seen.masks[0], torch.rot90(network.segment(image).masks[0], turns, dims=(0, 1))
    assert (mask & expected).sum() / (mask | expected).sum() > 0.9


def test_an_onnx_file_given_by_hand_is_used_at_its_own_size(tmp_path: Path) -> None:
    path = exported_path("yolo26n-seg", resolve("yolo26n-seg"), 320, 320)
    given = tmp_path / "mine.onnx"
    given.write_bytes(path.read_bytes())
    segmenter = YOLOSegmenter(SegmentationConfig(model="yolo26n-seg", threads=1), weights=given)
    assert (segmenter.height, segmenter.width) == (320, 320)
    assert segmenter.segment(photograph("astronaut")).labels[0] == PERSON


def test_the_export_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = resolve("yolo26n-seg")
    monkeypatch.setenv("V3D_CACHE", str(tmp_path))
    first = exported_path("yolo26n-seg", checkpoint, 64, 96)
    stamp = first.stat().st_mtime_ns
    assert exported_path("yolo26n-seg", checkpoint, 64, 96) == first
    assert first.stat().st_mtime_ns == stamp
    assert exported_path("yolo26n-seg", checkpoint, 96, 64) != first


def test_other_onnx_files_are_refused(tmp_path: Path) -> None:
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 64, 64])
    found = helper.make_tensor_value_info("output0", TensorProto.FLOAT, [1, 3, 64, 64])
    node = helper.make_node("Identity", ["images"], ["output0"])
    model = helper.make_model(
        helper.make_graph([node], "other", [image], [found]), opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    )
    path = tmp_path / "other.onnx"
    onnx.save(model, path)
    with pytest.raises(WeightsError, match=r"other\.onnx: is not a raw segmentation head"):
        YOLOSegmenter(SegmentationConfig(), weights=path)
    path.write_bytes(b"rubbish")
    with pytest.raises(WeightsError, match=r"other\.onnx: onnxruntime cannot open it"):
        YOLOSegmenter(SegmentationConfig(), weights=path)
    with pytest.raises(WeightsError, match=r"gone\.onnx: there is no such file"):
        YOLOSegmenter(SegmentationConfig(), weights=tmp_path / "gone.onnx")


def test_the_configuration_names_the_source(tmp_path: Path) -> None:
    frame = RGBDFrame(0, 0.0, photograph("coffee"), torch.zeros(1, 400, 600))
    assert COCO_NAMES[make_segmenter(SegmentationConfig(**SMALL))(frame).labels[0]] == "cup"
    nothing = make_segmenter(SegmentationConfig(source="none"))
    assert isinstance(nothing, NoSegmentation)
    assert nothing(frame).masks.shape == (0, 400, 600)
    with pytest.raises(ConfigError, match="folder"):
        make_segmenter(SegmentationConfig(source="masks"))
    Image.fromarray(np.zeros((400, 600), dtype=np.uint8)).save(tmp_path / "a.png")
    assert isinstance(make_segmenter(SegmentationConfig(source="masks"), masks_dir=tmp_path), MaskFolder)


def test_coco_has_80_classes() -> None:
    assert len(set(COCO_NAMES)) == 80
    assert PERSON == 0
    assert (COCO_NAMES[15], COCO_NAMES[41], COCO_NAMES[56], COCO_NAMES[79]) == ("cat", "cup", "chair", "toothbrush")


def test_people_of_a_real_sequence_are_found(v3d_data: Path) -> None:
    """Pixels of walking people that the masks of the recording know, every 20th frame."""
    segmenter = YOLOSegmenter(SegmentationConfig(threads=1))
    folder = v3d_data / "crowd_static"
    masks = sorted((folder / "masks").glob("*.png"))[::20]
    images = sorted((folder / "rgb").glob("*"))[::20]
    found = total = 0
    for mask_path, image_path in zip(masks, images, strict=True):
        walking = torch.from_numpy(np.array(Image.open(mask_path)))
        walking = (walking > 0) & (walking < 255)
        instances = segmenter.segment(torch.from_numpy(np.array(Image.open(image_path))).permute(2, 0, 1))
        people = instances.masks[instances.labels == PERSON].any(dim=0)
        found, total = found + int((people & walking).sum()), total + int(walking.sum())
    assert found / total > 0.85
