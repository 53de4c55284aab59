"""Figure of the votes: lines between centroids, votes without effect, mutual votes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from helpers.figure_pixels import count_pixels, is_colour, read_picture
from numpy.typing import NDArray

from v3d_torch.viz.object_overlay import Overlay
from v3d_torch.viz.voting import VOTE_COLOUR, save_voting_figure, split_votes


def draw_votes(
    path: Path, *vote_pairs: tuple[int, int], first: str = "static", second: str = "dynamic"
) -> NDArray[np.float64]:
    """Draw three objects: 1 at the left, 2 in the middle, and 3, without a centroid, at the right."""
    masks = torch.zeros(3, 120, 160, dtype=torch.bool)
    objects: dict[int, Overlay] = {}
    centres = {}
    for i, motion_state in enumerate((first, second, "static")):
        masks[i, 50:70, 20 + 50 * i : 40 + 50 * i] = True
        objects[i + 1] = (masks[i], "", motion_state)
        centres[i + 1] = torch.tensor([30.0 + 50 * i, 60.0])
    del centres[3]
    save_voting_figure(torch.zeros(3, 120, 160, dtype=torch.uint8), objects, centres, vote_pairs, path)
    return read_picture(path)[:720]  # without the legend


def test_vote_is_a_red_line_between_centroids(tmp_path: Path) -> None:
    image = draw_votes(tmp_path / "voted.png", (1, 2))
    _, columns = is_colour(image, VOTE_COLOUR).nonzero()
    width = image.shape[1]
    assert len(columns) > 500
    assert columns.min() / width > 30 / 160 - 0.02 and columns.max() / width < 80 / 160 + 0.02
    assert count_pixels(draw_votes(tmp_path / "none.png"), VOTE_COLOUR) == 0
    assert count_pixels(draw_votes(tmp_path / "nowhere.png", (1, 3), (3, 2)), VOTE_COLOUR) == 0  # 3 has no centroid


def test_votes_without_effect_are_thin_and_mutual_votes_are_one_line(tmp_path: Path) -> None:
    bold = draw_votes(tmp_path / "bold.png", (1, 2))
    thin = draw_votes(tmp_path / "thin.png", (1, 2), second="static")
    assert count_pixels(thin, VOTE_COLOUR) < 0.2 * count_pixels(bold, VOTE_COLOUR)
    assert thin[..., 0].max() > 0.4
    assert np.array_equal(draw_votes(tmp_path / "mutual.png", (1, 2), (2, 1)), bold)
    masks = torch.zeros(120, 160, dtype=torch.bool)
    for motion_state, expected in (("dynamic", False), ("static", True)):
        objects: dict[int, Overlay] = {1: (masks, "", "static"), 2: (masks, "", motion_state)}
        centres = {1: torch.tensor([30.0, 60.0]), 2: torch.tensor([80.0, 60.0])}
        save_voting_figure(
            torch.zeros(3, 120, 160, dtype=torch.uint8), objects, centres, [(1, 2)], tmp_path / "vote.svg"
        )
        assert ("without effect" in (tmp_path / "vote.svg").read_text()) == expected


def test_split_votes_by_hand() -> None:
    assert split_votes([(1, 2), (2, 1), (3, 1), (3, 4), (4, 3), (2, 5)], dynamic=[1]) == (
        [(1, 2), (1, 3)],
        [(2, 5), (3, 4)],
    )
    assert split_votes([], []) == ([], [])
