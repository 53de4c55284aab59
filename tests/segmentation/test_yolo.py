"""Networks with published weights on photographs. The weights come from the cache or a download, as for a user."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from helpers.library_settings import default_dtype, torch_threads
from helpers.photographs import photograph
from onnx import TensorProto, helper
from PIL import Image, ImageDraw
from torch import Tensor

import v3d_torch.segmentation.yolo
from v3d_torch.config import SegmentationConfig
from v3d_torch.errors import InputError, WeightsError
from v3d_torch.segmentation import COCO_NAMES, PERSON, YOLOSegmenter
from v3d_torch.segmentation.export import exported_path
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.segmentation.weights import REGISTRY, find_weights
from v3d_torch.types import RGBDFrame

SMALL = {"height": 320, "width": 320, "threads": 1}

LARGE = {"height": 480, "width": 640, "threads": 1}
"""Input size close to that of the photographs, so that downscaling does not affect the detections."""

ASTRONAUT = [(155, 60), (190, 20), (260, 20), (300, 70), (295, 120), (270, 150), (300, 215), (340, 260), (360, 350)]
ASTRONAUT += [(290, 390), (280, 511), (20, 511), (15, 400), (60, 250), (115, 200), (125, 160), (175, 140)]
"""Hand-drawn outline of the person, (u, v)."""


@pytest.fixture(scope="module", params=list(product(REGISTRY, ("float32", "int8"))), ids="-".join)
def segmenter(request: pytest.FixtureRequest) -> YOLOSegmenter:
    """Each model in each precision, the 8-bit one on every processor."""
    model, precision = request.param
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(v3d_torch.segmentation.yolo, "has_int8_instructions", lambda: True)
        return YOLOSegmenter(SegmentationConfig(model=model, precision=precision, **LARGE))


def test_person_mask_matches_hand_drawn_outline(segmenter: YOLOSegmenter) -> None:
    assert_mask_matches_outline(segmenter)


def test_person_mask_matches_hand_drawn_outline_at_default_size() -> None:
    assert_mask_matches_outline(YOLOSegmenter(SegmentationConfig(threads=1)))


def assert_mask_matches_outline(segmenter: YOLOSegmenter) -> None:
    instances = segmenter.segment(photograph("astronaut"))
    assert instances.labels[0] == PERSON
    assert instances.scores[0] > 0.8
    outline = Image.new("1", (512, 512))
    ImageDraw.Draw(outline).polygon(ASTRONAUT, fill=1)
    expected = torch.from_numpy(np.array(outline))
    mask = instances.masks[0]
    assert (mask & expected).sum() / (mask | expected).sum() > 0.9


@pytest.mark.parametrize(("name", "label", "area"), [("coffee", "cup", (0.15, 0.3)), ("chelsea", "cat", (0.6, 0.9))])
def test_cup_and_cat_are_detected(segmenter: YOLOSegmenter, name: str, label: str, area: tuple[float, float]) -> None:
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


@pytest.mark.parametrize(("name", "label"), [("coffee", "cup"), ("chelsea", "cat")])
def test_detections_in_a_dark_image_have_the_scores_of_a_bright_one(name: str, label: str) -> None:
    """Without brightening, the scores are below 0.5."""
    image, segmenter = photograph(name), YOLOSegmenter(SegmentationConfig(threads=1))
    dark, bright = segmenter.segment((image * 0.06).to(torch.uint8)), segmenter.segment(image)
    assert COCO_NAMES[dark.labels[0]] == label
    assert dark.scores[0] > bright.scores[0] - 0.05


def test_convention_channels_are_rgb(segmenter: YOLOSegmenter) -> None:
    """The score of a ginger cat drops when red and blue are swapped."""
    image = photograph("chelsea")
    in_rgb, in_bgr = (segmenter.segment(channels).scores for channels in (image, image.flip(0)))
    assert in_rgb[0] > (in_bgr[0] if len(in_bgr) else 0.0) + 0.05


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    image = photograph("coffee")
    one, two = (YOLOSegmenter(SegmentationConfig(**(SMALL | {"threads": threads}))) for threads in (1, 2))
    first, again = one.segment(image), one.segment(image)
    with torch_threads(2):
        other = two.segment(image)
    for name in ("masks", "labels", "scores", "boxes"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert torch.equal(getattr(first, name), getattr(other, name))


def test_mirrored_image_gives_mirrored_mask() -> None:
    """A shift of a pixel or two on the way to the canvas and back would break the symmetry."""
    segmenter = YOLOSegmenter(SegmentationConfig(**LARGE))
    image = photograph("astronaut")
    mask = segmenter.segment(image).masks[0]
    mirrored = segmenter.segment(image.flip(2)).masks[0].flip(1)
    assert (mask & mirrored).sum() / (mask | mirrored).sum() > 0.975


@pytest.mark.parametrize("turns", range(4))
def test_person_is_detected_at_every_roll_of_the_camera(turns: int) -> None:
    """The mask is that of the upright image, rotated like the image."""
    network = YOLOSegmenter(SegmentationConfig(**LARGE))
    image = photograph("astronaut")
    rotated = torch.rot90(image, turns, dims=(1, 2)).contiguous()
    frame = RGBDFrame(0, 0.0, rotated, torch.ones(1, 512, 512))
    instances = UprightSegmenter(network).segment_with_pose(frame, torch.eye(4, dtype=torch.float64))
    assert instances.labels[0] == PERSON
    mask, expected = instances.masks[0], torch.rot90(network.segment(image).masks[0], turns, dims=(0, 1))
    assert (mask & expected).sum() / (mask | expected).sum() > 0.9


def test_onnx_file_of_the_user_keeps_its_input_size(tmp_path: Path) -> None:
    path = exported_path("yolo26n-seg", find_weights("yolo26n-seg"), 320, 320)
    user_file = tmp_path / "mine.onnx"
    user_file.write_bytes(path.read_bytes())
    for weights in (user_file, str(user_file)):
        segmenter = YOLOSegmenter(SegmentationConfig(model="yolo26n-seg", threads=1), weights=weights)
        assert (segmenter.height, segmenter.width) == (320, 320)
        assert segmenter.segment(photograph("astronaut")).labels[0] == PERSON


def test_onnx_file_with_an_upper_case_suffix_is_read(tmp_path: Path) -> None:
    path = tmp_path / "MINE.ONNX"
    path.write_bytes(exported_path("yolo26n-seg", find_weights("yolo26n-seg"), 320, 320).read_bytes())
    assert YOLOSegmenter(SegmentationConfig(threads=1), weights=path).height == 320


@pytest.mark.parametrize(
    ("convert", "message"),
    [
        (lambda image: image / 255, r"torch.float32 of shape \(3, 512, 512\), expected a tensor, torch.uint8 of shape"),
        (lambda image: image.permute(1, 2, 0), r"torch.uint8 of shape \(512, 512, 3\), expected"),
        (lambda image: image[:1], r"torch.uint8 of shape \(1, 512, 512\), expected"),
        (lambda image: image.numpy(), "a ndarray, expected a tensor"),
    ],
)
def test_images_that_are_not_rgb_in_uint8_are_rejected(convert: Callable[[Tensor], object], message: str) -> None:
    """The network finds nothing in an image from 0 to 1, which it takes for a black one."""
    segmenter = YOLOSegmenter(SegmentationConfig(threads=1))
    with pytest.raises(InputError, match=f"^the image to segment is {message}"):
        segmenter.segment(convert(photograph("astronaut")))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Network for images of 64 x 96 pixels, exported into a cache of its own."""
    weights = find_weights("yolo26n-seg")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("V3D_CACHE", str(tmp_path_factory.mktemp("cache")))
        return exported_path("yolo26n-seg", weights, 64, 96)


def test_network_is_exported_once_for_each_size(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weights, stamp = find_weights("yolo26n-seg"), exported.stat().st_mtime_ns
    monkeypatch.setenv("V3D_CACHE", str(exported.parents[1]))
    assert exported_path("yolo26n-seg", weights, 64, 96) == exported
    assert exported.stat().st_mtime_ns == stamp
    assert exported_path("yolo26n-seg", weights, 96, 64) != exported
    assert torch.get_default_dtype() == torch.float32


def test_exported_network_does_not_depend_on_the_default_dtype(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = find_weights("yolo26n-seg")
    monkeypatch.setenv("V3D_CACHE", str(tmp_path))
    with default_dtype(torch.float64):
        assert exported_path("yolo26n-seg", weights, 64, 96).read_bytes() == exported.read_bytes()
        assert torch.get_default_dtype() == torch.float64


def test_damaged_files_of_a_network_in_the_cache_are_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A flipped bit in the weights still gives a network that runs, with other masks."""
    weights = find_weights("yolo26n-seg")
    monkeypatch.setenv("V3D_CACHE", str(tmp_path))
    config = SegmentationConfig(model="yolo26n-seg", precision="float32", height=64, width=96, threads=1)
    YOLOSegmenter(config, weights)
    files = sorted((tmp_path / "networks").glob("*.onnx"))
    before = [path.read_bytes() for path in files]
    for path, content in zip(files, before, strict=True):
        middle = len(content) // 2
        path.write_bytes(content[:middle] + bytes([content[middle] ^ 0x40]) + content[middle + 1 :])
    YOLOSegmenter(config, weights)
    assert [path.read_bytes() for path in files] == before


def test_truncated_onnx_file_of_the_user_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "mine.onnx"
    path.write_bytes(exported_path("yolo26n-seg", find_weights("yolo26n-seg"), 320, 320).read_bytes()[:100_000])
    with pytest.raises(WeightsError, match=r"mine\.onnx: is not a network that onnxruntime can load"):
        YOLOSegmenter(SegmentationConfig(), weights=path)


def test_onnx_files_without_a_raw_head_are_rejected(tmp_path: Path) -> None:
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 64, 64])
    output = helper.make_tensor_value_info("output0", TensorProto.FLOAT, [1, 3, 64, 64])
    node = helper.make_node("Identity", ["images"], ["output0"])
    model = helper.make_model(
        helper.make_graph([node], "other", [image], [output]), opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    )
    path = tmp_path / "other.onnx"
    onnx.save(model, path)
    with pytest.raises(WeightsError, match=r"other\.onnx: is not a raw segmentation head"):
        YOLOSegmenter(SegmentationConfig(), weights=path)
    path.write_bytes(b"not a network")
    with pytest.raises(WeightsError, match=r"other\.onnx: is not a network that onnxruntime can load"):
        YOLOSegmenter(SegmentationConfig(), weights=path)
    with pytest.raises(WeightsError, match=r"gone\.onnx: no such file; check"):
        YOLOSegmenter(SegmentationConfig(), weights=tmp_path / "gone.onnx")


def test_people_in_a_real_sequence_are_detected(real_sequence: Callable[[str], Path]) -> None:
    """Recall of the pixels of walking people in the masks of the recording, every 20th frame."""
    folder = real_sequence("crowd_static")
    segmenter = YOLOSegmenter(SegmentationConfig(threads=1))
    masks = sorted((folder / "masks").glob("*.png"))[::20]
    images = sorted((folder / "rgb").glob("*"))[::20]
    detected = total = 0
    for mask_path, image_path in zip(masks, images, strict=True):
        walking = torch.from_numpy(np.array(Image.open(mask_path)))
        walking = (walking > 0) & (walking < 255)
        instances = segmenter.segment(torch.from_numpy(np.array(Image.open(image_path))).permute(2, 0, 1))
        people = instances.masks[instances.labels == PERSON].any(dim=0)
        detected, total = detected + int((people & walking).sum()), total + int(walking.sum())
    assert detected / total > 0.85
