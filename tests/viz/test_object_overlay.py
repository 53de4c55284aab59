"""Frames with masks: tints, outlines, labels, legend, grid."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.figure_pixels import count_pixels, read_picture
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from skimage.color import rgb2lab

from v3d_torch.viz.label_placement import separate_labels
from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS, draw_objects, save_mask_figure
from v3d_torch.viz.pose_timelines import STATUS_COLOURS


def frames(number: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(1)
    images = [torch.randint(0, 256, (3, 120, 160), dtype=torch.uint8, generator=generator) for _ in range(number)]
    masks = [torch.zeros(120, 160, dtype=torch.bool) for _ in range(number)]
    for mask in masks:
        mask[20:115, 30:130] = True
    return images, masks


@pytest.mark.parametrize("motion_state", [*MOTION_STATE_COLOURS, "some other word"])
def test_masks_are_tinted_by_motion_state(tmp_path: Path, motion_state: str) -> None:
    images, masks = frames(1)
    images = [torch.zeros_like(images[0])]
    save_mask_figure(images, [[(masks[0], "person 3", motion_state)]], tmp_path / "masks.png")
    image = read_picture(tmp_path / "masks.png")
    colour = MOTION_STATE_COLOURS.get(motion_state, MOTION_STATE_COLOURS["unknown"])
    tint = np.array(to_rgb(colour)) * 0.45
    inside = (np.abs(image - tint).max(axis=2) < 0.02).mean()
    assert 0.3 < inside < 95 * 100 / (120 * 160)
    assert count_pixels(image, colour) > 500  # outline, label, legend
    # The edges of letters are grey, the colour of unknown.
    others = set(MOTION_STATE_COLOURS.values()) - {
        colour,
        MOTION_STATE_COLOURS["unknown"],
    }
    assert all(count_pixels(image, other) == 0 for other in others)


def test_legend_has_the_motion_states_in_view(tmp_path: Path) -> None:
    images, masks = frames(2)
    overlays = [[(masks[0], "person 3", "dynamic")], [(masks[1], "chair 4", "static"), (~masks[1], "cup 5", "static")]]
    save_mask_figure(images, overlays, tmp_path / "masks.svg")
    words = re.findall(r"<!-- (.+?) -->", (tmp_path / "masks.svg").read_text())
    assert words == ["person 3", "chair 4", "cup 5", "static", "dynamic"]


@pytest.mark.parametrize(("number", "columns", "rows"), [(1, 1, 1), (2, 2, 1), (4, 3, 2), (6, 3, 2), (9, 3, 2)])
def test_at_most_six_frames_in_rows_of_three(tmp_path: Path, number: int, columns: int, rows: int) -> None:
    images, masks = frames(number)
    save_mask_figure(images, [[(mask, "person 1", "static")] for mask in masks], tmp_path / "masks.svg")
    drawing = (tmp_path / "masks.svg").read_text()
    assert drawing.count("<!-- person 1 -->") == min(number, 6)
    width, height = map(float, re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', drawing)[0])
    assert width / height == pytest.approx(4 * columns / (3 * rows + 0.4), rel=0.01)


@pytest.mark.parametrize(("number", "drawn"), [(7, "0 1 2 4 5 6"), (12, "0 2 4 7 9 11")])
def test_frames_from_the_first_to_the_last_are_drawn(tmp_path: Path, number: int, drawn: str) -> None:
    images, masks = frames(number)
    save_mask_figure(images, [[(mask, str(i), "static")] for i, mask in enumerate(masks)], tmp_path / "masks.svg")
    assert re.findall(r"<!-- (\d+) -->", (tmp_path / "masks.svg").read_text()) == drawn.split()


def test_objects_out_of_view_have_no_label_and_missing_arguments_are_errors(tmp_path: Path) -> None:
    images, masks = frames(2)
    save_mask_figure(images, [[(torch.zeros_like(masks[0]), "person 1", "dynamic")], []], tmp_path / "masks.svg")
    assert "person 1" not in (tmp_path / "masks.svg").read_text()
    with pytest.raises(ValueError, match="at least one image"):
        save_mask_figure([], [], tmp_path / "masks.png")
    with pytest.raises(ValueError, match="zip"):
        save_mask_figure(images, [[]], tmp_path / "masks.png")


def test_same_masks_give_same_bytes(tmp_path: Path) -> None:
    images, masks = frames(1)
    for name in ("a", "b"):
        save_mask_figure(images, [[(masks[0], "person 3", "dynamic")]], tmp_path / f"{name}.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_labels_of_moving_objects_are_drawn_over_those_of_static_objects() -> None:
    axes, mask = Figure().add_subplot(), torch.ones(12, 16, dtype=torch.bool)
    states = {"a": "dynamic", "b": "static", "c": "unknown", "d": "static"}
    draw_objects(
        axes, torch.zeros(3, 12, 16, dtype=torch.uint8), [(mask, label, state) for label, state in states.items()]
    )
    assert [text.get_text() for text in axes.texts] == ["b", "d", "a", "c"]  # later labels cover earlier ones


# Simulated colour vision, linear RGB (Machado et al., TVCG 2009, severity 1)
VISION = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}


@pytest.mark.parametrize("vision", [np.eye(3), *map(np.array, VISION.values())], ids=["normal", *VISION])
@pytest.mark.parametrize("colours", [MOTION_STATE_COLOURS, STATUS_COLOURS], ids=["motion states", "statuses"])
def test_colours_differ_for_colour_blind_people(colours: dict[str, str], vision: np.ndarray) -> None:
    seen = []
    for colour in colours.values():
        rgb = np.array(to_rgb(colour))
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        linear = np.clip(vision @ linear, 0, 1)
        rgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        seen.append(rgb2lab(rgb.reshape(1, 1, 3)).ravel())
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 20


def test_labels_at_the_same_place_do_not_cover_each_other() -> None:
    figure = Figure(figsize=(6, 4.5))
    axes = figure.add_subplot()
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[20:25, 58:64] = True
    objects = [(mask, f"dining table {number}", "static") for number in range(4)]
    draw_objects(axes, torch.zeros(3, 48, 64, dtype=torch.uint8), objects)
    separate_labels(figure)
    figure.draw_without_rendering()  # moves the boxes to the labels
    patches = [text.get_bbox_patch() for text in axes.texts]
    boxes = [patch.get_window_extent() for patch in patches if patch is not None]
    assert len(boxes) == 4
    assert not any(a.overlaps(b.shrunk(0.99, 0.99)) for a, b in combinations(boxes, 2))
    assert all(axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 + 1 for box in boxes)


def test_labels_stay_inside_the_image_and_those_left_out_are_counted(tmp_path: Path) -> None:
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[44:, 20:40] = True
    figure = Figure(figsize=(4, 3))
    axes = figure.add_subplot()
    objects = [(mask, f"chair {number}", "static") for number in range(4)]
    draw_objects(axes, torch.zeros(3, 48, 64, dtype=torch.uint8), objects)
    hidden = separate_labels(figure)
    figure.draw_without_rendering()
    shown = [patch for text in axes.texts if text.get_visible() and (patch := text.get_bbox_patch()) is not None]
    assert len(shown) == 4 - hidden and 0 < hidden < 4
    boxes = [patch.get_window_extent() for patch in shown]
    assert all(axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 + 1 for box in boxes)
    assert all(axes.bbox.y0 - 1 <= box.y0 and box.y1 <= axes.bbox.y1 + 1 for box in boxes)
    save_mask_figure([torch.zeros(3, 48, 64, dtype=torch.uint8)], [objects], tmp_path / "masks.svg")
    drawing = (tmp_path / "masks.svg").read_text()
    assert f"<!-- {4 - drawing.count('<!-- chair')} names left out -->" in drawing
