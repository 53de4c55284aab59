"""User text in figures: no warnings and no boxes for characters that the default font lacks."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.occupancy_scenes import map_of
from matplotlib import font_manager, get_data_path
from matplotlib.figure import Figure

from v3d_torch.pipeline.run_record import ObjectTable
from v3d_torch.types import Trajectory
from v3d_torch.viz.figure_output import save_figure
from v3d_torch.viz.fonts import _characters, _families, draw_title, drawable_text
from v3d_torch.viz.objects_figure import draw_objects_from_above
from v3d_torch.viz.occupancy_figure import draw_occupancy
from v3d_torch.viz.trajectory_figure import draw_trajectory

NAMES = ["部屋 室", "हिन्दी", "مطبخ", "a\tb\x07\x1b", "two\nlines", "😀\u200d\U000e0001", "$x^{"]


POSES = Trajectory(torch.arange(3.0), torch.eye(4, dtype=torch.float64).repeat(3, 1, 1))
VOXELS = torch.tensor([[0, 0, 0], [1, 0, 0]])  # one occupied, one free
UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
FIGURES: dict[str, Callable[[str], Figure]] = {
    "trajectory": lambda title: draw_trajectory(None, POSES, title),
    "objects": lambda title: draw_objects_from_above(ObjectTable(), POSES, torch.zeros(1, 3), UP, title),
    "occupancy": lambda title: draw_occupancy(map_of(VOXELS[:1], VOXELS[1:]), POSES, UP, None, title),
}


@pytest.mark.parametrize("kind", FIGURES)
@pytest.mark.parametrize("name", NAMES)
def test_figure_with_any_name_is_drawn_without_warnings(kind: str, name: str, tmp_path: Path) -> None:
    with warnings.catch_warnings(action="error"):
        save_figure(FIGURES[kind](name), tmp_path / "figure.png")


def test_text_of_the_default_font_is_unchanged() -> None:
    for name in ("fr3/w/xyz", "кухня", "Größe", "two\nlines"):
        assert drawable_text(name) == (name, ["DejaVu Sans"])


def test_characters_without_a_font_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v3d_torch.viz.fonts._families", dict)
    assert drawable_text("部屋 1\t2") == ("?? 1 2", ["DejaVu Sans"])


def test_characters_of_another_font_are_drawn_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The font of mathematics that comes with matplotlib has letters that the default font lacks."""
    path = str(Path(get_data_path()) / "fonts/ttf/STIXNonUni.ttf")
    letter = min(_characters(path) - _characters(font_manager.findfont("DejaVu Sans")))
    monkeypatch.setattr("v3d_torch.viz.fonts._families", lambda: {"broken": "/dev/null", "STIXNonUnicode": path})
    assert drawable_text(f"a{letter}部") == (f"a{letter}?", ["DejaVu Sans", "STIXNonUnicode"])


def test_fonts_of_boxes_are_not_used() -> None:
    assert _families() and not any(name.startswith("Last Resort") for name in _families())


def test_middle_of_a_long_title_is_left_out() -> None:
    axes = Figure().add_subplot()
    draw_title(axes.set_title, "beginning_" + 100 * "x" + "_end")
    title = axes.get_title()
    assert len(title) <= 51 and title.startswith("beginning_") and title.endswith("_end")
