"""Instances from id images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from v3d_torch.errors import InputError
from v3d_torch.segmentation import PERSON, MaskFolder
from v3d_torch.segmentation.coco import COCO_NAMES
from v3d_torch.types import RGBDFrame


def frame(index: int, stamp: float, height: int = 12, width: int = 16) -> RGBDFrame:
    """Black frame without depth."""
    return RGBDFrame(index, stamp, torch.zeros(3, height, width, dtype=torch.uint8), torch.zeros(1, height, width))


def ids(dtype: type, *values: int) -> np.ndarray:
    """Id image with a rectangle of 4 x 3 pixels for each value, side by side from row 2, column 1."""
    image = np.zeros((12, 16), dtype=dtype)
    for place, value in enumerate(values):
        image[2:6, 1 + 4 * place : 4 + 4 * place] = value
    return image


@pytest.mark.parametrize(("dtype", "values"), [(np.uint8, (255, 7)), (np.uint16, (40_000, 300))])
def test_every_nonzero_value_is_an_instance(tmp_path: Path, dtype: type, values: tuple[int, int]) -> None:
    Image.fromarray(ids(dtype, *values)).save(tmp_path / "10.000000.png")
    instances, read_ids = MaskFolder(tmp_path).read(frame(0, 10.0))
    assert read_ids.tolist() == sorted(values)
    assert instances.labels.tolist() == [PERSON, PERSON]
    assert instances.scores.tolist() == [1, 1]
    assert instances.boxes.tolist() == [[5, 2, 8, 6], [1, 2, 4, 6]]  # edges: pixels 5, 6 and 7 lie between 5 and 8
    for mask, value in zip(instances.masks, sorted(values), strict=True):
        assert np.array_equal(mask.numpy(), ids(dtype, *values) == value)


@pytest.mark.parametrize("name", ["labels.yaml", "labels.yml"])
def test_labels_file_gives_the_classes_and_selects_the_ids(tmp_path: Path, name: str) -> None:
    Image.fromarray(ids(np.uint8, 9, 4, 7)).save(tmp_path / "10.000000.png")
    (tmp_path / name).write_text("7: person\n4: chair\n")
    instances, read_ids = MaskFolder(tmp_path).read(frame(0, 10.0))
    assert read_ids.tolist() == [4, 7]
    assert [COCO_NAMES[label] for label in instances.labels] == ["chair", "person"]
    assert np.array_equal(instances.masks[1].numpy(), ids(np.uint8, 9, 4, 7) == 7)


@pytest.mark.parametrize("text", ["4: throne", "- chair", "four: chair", "4: [chair", "4: [chair]", ""])
def test_invalid_labels_are_one_sentence(tmp_path: Path, text: str) -> None:
    Image.fromarray(ids(np.uint8, 4)).save(tmp_path / "10.000000.png")
    (tmp_path / "labels.yaml").write_text(text)
    with pytest.raises(InputError, match=r"labels\.yaml: .* line such as 4: chair for each id"):
        MaskFolder(tmp_path)


@pytest.mark.parametrize("text", ["0: person\n56: chair\n", "-1: cup\n"])
def test_label_of_the_background_is_rejected(tmp_path: Path, text: str) -> None:
    """Ids that are class indices have people as 0, who would be part of the background."""
    Image.fromarray(ids(np.uint8, 4)).save(tmp_path / "a.png")
    (tmp_path / "labels.yaml").write_text(text)
    with pytest.raises(InputError, match=r"labels\.yaml: has the id (0|-1), but 0 is the background; number"):
        MaskFolder(tmp_path)


def test_ids_of_a_palette_image_are_its_palette_indices(tmp_path: Path) -> None:
    image = Image.fromarray(ids(np.uint8, 3)).convert("P")
    image.putpalette([value for index in range(256) for value in (255 - index, index, 0)])
    image.putdata(ids(np.uint8, 3).flatten().tolist())
    image.save(tmp_path / "a.png")
    assert MaskFolder(tmp_path).read(frame(0, 0.0))[1].tolist() == [3]


def test_image_without_ids_gives_no_instances(tmp_path: Path) -> None:
    Image.fromarray(ids(np.uint8)).save(tmp_path / "a.png")
    instances = MaskFolder(tmp_path)(frame(0, 0.0))
    assert (len(instances), instances.masks.shape, instances.boxes.shape) == (0, (0, 12, 16), (0, 4))


def test_files_named_by_timestamp_belong_to_the_nearest_frame(tmp_path: Path) -> None:
    for value, stamp in ((1, "5.000000"), (2, "5.033333"), (3, "5.100000")):
        Image.fromarray(ids(np.uint8, value)).save(tmp_path / f"{stamp}.png")
    masks = MaskFolder(tmp_path)
    assert masks.read(frame(9, 5.02))[1].tolist() == [2]
    assert masks.read(frame(9, 4.985))[1].tolist() == [1]
    with pytest.raises(InputError, match=r"no id image for frame 9 at 5\.075000 s"):
        masks(frame(9, 5.075))


def test_missing_file_is_not_replaced_by_that_of_the_next_frame(tmp_path: Path) -> None:
    """At 60 Hz, the files of the frames before and after are only 16.7 ms away."""
    for value in (1, 2, 3, 5, 6):
        Image.fromarray(ids(np.uint8, value)).save(tmp_path / f"{value / 60:.6f}.png")
    masks = MaskFolder(tmp_path)
    assert masks.read(frame(2, 3 / 60 + 0.005))[1].tolist() == [3]
    with pytest.raises(InputError, match=r"no id image for frame 3 at 0\.066667 s"):
        masks(frame(3, round(4 / 60, 6)))


@pytest.mark.parametrize("name", ["{:.0f}", "mask_{:.0f}"])
def test_names_in_nanoseconds_belong_to_the_nearest_frame(tmp_path: Path, name: str) -> None:
    start = 1_403_636_579.763555
    for value in (1, 2, 3):
        Image.fromarray(ids(np.uint8, value)).save(tmp_path / f"{name.format((start + value / 30) * 1e9)}.png")
    masks = MaskFolder(tmp_path)
    masks.check_number(2)
    masks.check_stamps(torch.tensor([start + 1 / 30, start + 3 / 30], dtype=torch.float64))
    assert [masks.read(frame(i, start + value / 30))[1].tolist() for i, value in enumerate((1, 3))] == [[1], [3]]


def test_other_names_need_one_file_for_each_frame(tmp_path: Path) -> None:
    for value in (1, 2, 3):
        Image.fromarray(ids(np.uint8, value)).save(tmp_path / f"{value:06d}.png")
    masks = MaskFolder(tmp_path)
    masks.check_number(3)
    with pytest.raises(InputError, match="has 3 id images for 2 frames, and their names are not timestamps; name each"):
        masks.check_number(2)


def test_files_with_other_names_belong_to_frames_in_order(tmp_path: Path) -> None:
    for value in (1, 2):
        Image.fromarray(ids(np.uint8, value)).save(tmp_path / f"{value:06d}.png")
    masks = MaskFolder(tmp_path)
    assert [masks.read(frame(index, 100.0))[1].tolist() for index in (0, 1)] == [[1], [2]]
    with pytest.raises(InputError, match="no id image for frame 2"):
        masks(frame(2, 100.0))


def test_numbers_in_names_are_compared_as_numbers(tmp_path: Path) -> None:
    for value in range(1, 13):
        Image.fromarray(ids(np.uint8, value)).save(tmp_path / f"{value}.png")
    Image.fromarray(ids(np.uint8, 99)).save(tmp_path / "0.jpg")
    masks = MaskFolder(tmp_path)
    assert [masks.read(frame(index, 100.0))[1].tolist() for index in range(12)] == [[i] for i in range(1, 13)]


def test_folder_is_accepted_as_a_string(tmp_path: Path) -> None:
    Image.fromarray(ids(np.uint8, 3)).save(tmp_path / "a.png")
    assert MaskFolder(str(tmp_path)).read(frame(0, 0.0))[1].tolist() == [3]
    with pytest.raises(InputError, match="gone: does not exist; name the folder"):
        MaskFolder(str(tmp_path / "gone"))


def test_unusable_id_images_are_rejected_by_path(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains no PNG files"):
        MaskFolder(tmp_path)
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((12, 16, 3), dtype=np.uint8)).save(path)
    with pytest.raises(InputError, match=r"a\.png: has 3 channels, expected one 8- or 16-bit channel"):
        MaskFolder(tmp_path)(frame(0, 0.0))
    Image.fromarray(ids(np.uint8, 1)).save(path)
    with pytest.raises(InputError, match=r"a\.png: has 16x12 pixels, its frame 16x24"):
        MaskFolder(tmp_path)(frame(0, 0.0, height=24))
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match=r"a\.png: is not a readable PNG"):
        MaskFolder(tmp_path)(frame(0, 0.0))


def test_id_image_that_would_fill_the_memory_is_not_decoded(tmp_path: Path) -> None:
    Image.new("1", (8200, 8200)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png: has more than 64 million pixels"):
        MaskFolder(tmp_path)(frame(0, 0.0))


def test_every_frame_of_a_real_sequence_has_an_id_image(real_sequence: Callable[[str], Path]) -> None:
    folder = real_sequence("crowd_static")
    pairs = [line.split() for line in (folder / "associations.txt").read_text().splitlines() if line[:1] != "#"]
    masks = MaskFolder(folder / "masks")
    stamps = sorted(float(field) for pair in pairs for field in pair[:3:2])[::2]
    counts = [len(masks(frame(index, stamp, 480, 640))) for index, stamp in enumerate(stamps[::20])]
    assert max(counts) >= 2
