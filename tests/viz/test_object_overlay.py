"""Frames with masks: tints, outlines, labels, legend, grid."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.pictures import count_pixels, read_picture
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from v3d_torch.viz.object_overlay import MOTION_STATE_COLOURS, draw_objects, save_mask_figure


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
